// Vectors of three numbers.
const dot = (a, b) => a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
const scaled = (a, s) => [a[0] * s, a[1] * s, a[2] * s];
const sum = (...all) => all.reduce((a, b) => [a[0] + b[0], a[1] + b[1], a[2] + b[2]]);
const cross = (a, b) => [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]];
const unit = (a) => scaled(a, 1 / Math.hypot(...a));
const clamp = (x, low, high) => Math.min(Math.max(x, low), high);
const RADIANS = Math.PI / 180;

// Unit vector of an azimuth and an elevation above the horizon, both in degrees; z is up. And back.
const direction = (azimuth, elevation) => [
  Math.cos(elevation * RADIANS) * Math.cos(azimuth * RADIANS),
  Math.cos(elevation * RADIANS) * Math.sin(azimuth * RADIANS),
  Math.sin(elevation * RADIANS),
];
const angles = (w) => [Math.atan2(w[1], w[0]) / RADIANS, Math.asin(clamp(w[2], -1, 1)) / RADIANS];
