// Where the points of lifts are in the images: node projection.ts < answer.json  (node 22.18 on)
//
// Reads an answer of `POST /lift`, canonical or in the room. Prints frames x views x keypoints x
// (x, y) as JSON: pixels, with the origin that the lifted keypoints had; null: no answer.

import { readFileSync } from "node:fs";

type Camera = "weak_perspective" | "perspective" | "fisheye";
interface View {
  camera: Camera;
  rotation: number[][];
  scale: number;
  translation: number[];
  focal: number[] | null;
  principal_point: number[] | null;
  distortion: number[] | null;
}
interface Frame {
  points3d: (number[] | null)[] | null;
  views: (View | null)[];
}

/** Return the pixels (x, y) of a point in a view. */
function project(point: number[], view: View): number[] {
  const [x, y, z] = view.rotation.map((row) => row.reduce((sum, r, i) => sum + r * point[i], 0));
  const [tx, ty, tz] = view.translation;
  if (view.camera === "weak_perspective") return [view.scale * x + tx, view.scale * y + ty];
  const [a, b] = bend((x + tx) / (z + tz), (y + ty) / (z + tz), view.camera, view.distortion!);
  const [fx, fy] = view.focal!;
  const [cx, cy] = view.principal_point!;
  return [fx * a + cx, fy * b + cy];
}

/** Return a direction (a, b) at depth 1 as the lens bends it: OpenCV's two models. */
function bend(a: number, b: number, camera: Camera, distortion: number[]): number[] {
  const r2 = a * a + b * b;
  if (camera === "fisheye") {
    const [k1, k2, k3, k4] = distortion;
    const r = Math.max(Math.sqrt(r2), 1e-12);
    const t2 = Math.atan(r) ** 2;
    const bent = (Math.atan(r) / r) * (1 + t2 * (k1 + t2 * (k2 + t2 * (k3 + t2 * k4))));
    return [a * bent, b * bent];
  }
  const [k1, k2, p1, p2, k3, k4, k5, k6] = distortion;
  const radial = (1 + r2 * (k1 + r2 * (k2 + r2 * k3))) / (1 + r2 * (k4 + r2 * (k5 + r2 * k6)));
  return [
    a * radial + 2 * p1 * a * b + p2 * (r2 + 2 * a * a),
    b * radial + p1 * (r2 + 2 * b * b) + 2 * p2 * a * b,
  ];
}

const frames: Frame[] = JSON.parse(readFileSync(0, "utf8")).frames;
const seen = frames.map(({ points3d, views }) =>
  views.map((view) => view && points3d!.map((point) => point && project(point, view))),
);
console.log(JSON.stringify(seen));
