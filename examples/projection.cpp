// Where the points of lifts are in the images: ./projection KEYPOINTS < answers
//
// g++ -std=c++17 -O2 projection.cpp -o projection
//
// Reads answers of a stream as bytes (docs/streaming.md), one after the other, canonical or in the
// room. Prints for each frame, view and keypoint x and y: pixels, with the origin that the lifted
// keypoints had; nan where there is no answer.

#include <algorithm>
#include <cmath>
#include <cstdint>
#include <cstdio>
#include <cstdlib>
#include <vector>

#pragma pack(push, 1)
struct Header { uint8_t kind, flags; uint16_t views; uint32_t sequence; };
struct View {
  int32_t camera;  // -1 none, 0 weak perspective, 1 perspective, 2 fisheye
  float rotation[3][3], scale, translation[3], focal[2], principal_point[2], distortion[8],
      reprojection_error;
};
struct Point { float at[3]; };
#pragma pack(pop)
struct Pixel { double x, y; };

// A direction (a, b) at depth 1 as the lens bends it: OpenCV's two models.
Pixel bend(double a, double b, int camera, const float* k) {
  double r2 = a * a + b * b;
  if (camera == 2) {
    double r = std::max(std::sqrt(r2), 1e-12), t2 = std::pow(std::atan(r), 2);
    double bent = std::atan(r) / r * (1 + t2 * (k[0] + t2 * (k[1] + t2 * (k[2] + t2 * k[3]))));
    return {a * bent, b * bent};
  }
  double k1 = k[0], k2 = k[1], p1 = k[2], p2 = k[3], k3 = k[4], k4 = k[5], k5 = k[6], k6 = k[7];
  double radial =
      (1 + r2 * (k1 + r2 * (k2 + r2 * k3))) / (1 + r2 * (k4 + r2 * (k5 + r2 * k6)));
  return {a * radial + 2 * p1 * a * b + p2 * (r2 + 2 * a * a),
          b * radial + p1 * (r2 + 2 * b * b) + 2 * p2 * a * b};
}

Pixel project(const Point& point, const View& view) {
  double x[3];
  for (int i = 0; i < 3; ++i) {
    x[i] = 0;
    for (int j = 0; j < 3; ++j) x[i] += double(view.rotation[i][j]) * point.at[j];
  }
  const float *t = view.translation, *f = view.focal, *c = view.principal_point;
  if (view.camera < 0) return {NAN, NAN};
  if (view.camera == 0) return {view.scale * x[0] + t[0], view.scale * x[1] + t[1]};
  double z = x[2] + t[2];
  Pixel bent = bend((x[0] + t[0]) / z, (x[1] + t[1]) / z, view.camera, view.distortion);
  return {f[0] * bent.x + c[0], f[1] * bent.y + c[1]};
}

int main(int, char** arguments) {
  size_t keypoints = std::strtoul(arguments[1], nullptr, 10);
  Header header;
  while (std::fread(&header, sizeof header, 1, stdin) == 1) {
    std::vector<Point> points(keypoints);
    std::vector<View> views(header.views);
    std::vector<uint8_t> seen((keypoints + 3) / 4 * 4);
    std::vector<float> outlier_probability(views.size() * keypoints);
    std::vector<float> points3d_sd(keypoints);  // of streams with "uncertainty": "sd", the default
    struct { float quality; uint8_t reason, zeros[3]; } reliance;  // of the same streams
    if (std::fread(points.data(), sizeof(Point), keypoints, stdin) != keypoints ||
        std::fread(views.data(), sizeof(View), views.size(), stdin) != views.size() ||
        std::fread(seen.data(), 1, seen.size(), stdin) != seen.size() ||
        std::fread(outlier_probability.data(), sizeof(float), outlier_probability.size(), stdin) !=
            outlier_probability.size() ||
        std::fread(points3d_sd.data(), sizeof(float), keypoints, stdin) != keypoints ||
        std::fread(&reliance, sizeof reliance, 1, stdin) != 1)
      return 1;
    for (const View& view : views)
      for (const Point& point : points) {
        Pixel pixel = project(point, view);
        std::printf("%.9g %.9g\n", pixel.x, pixel.y);
      }
  }
}
