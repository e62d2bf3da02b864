/** A matt surface under a sky and one lamp. The library's own can do a hundred things more, and takes
 * several times as long to compile. */

import { ShaderMaterial } from "three";

const VERTEX = `
varying vec3 shown;
void main() {
  vec3 side = normalize(mat3(instanceMatrix) * normal);
  float lamp = 1.6 * max(0.0, dot(side, normalize(vec3(1.0, 3.0, 2.0))));
  vec3 sky = 2.1 * mix(vec3(0.32, 0.35, 0.39), vec3(1.0), 0.5 + 0.5 * side.y);
  shown = instanceColor * (lamp + sky) / 3.14159;
  gl_Position = projectionMatrix * modelViewMatrix * instanceMatrix * vec4(position, 1.0);
}`;
const FRAGMENT = `
uniform float opacity;
varying vec3 shown;
void main() {
  gl_FragColor = vec4(shown, opacity);
  #include <colorspace_fragment>
}`;

/** Returns the material of instances that have a colour each. */
export function litMaterial(opacity: number): ShaderMaterial {
  const pale = opacity < 1;
  return new ShaderMaterial({
    vertexShader: VERTEX,
    fragmentShader: FRAGMENT,
    uniforms: { opacity: { value: opacity } },
    transparent: pale,
    depthWrite: !pale,
  });
}
