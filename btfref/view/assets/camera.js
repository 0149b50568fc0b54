// A camera that orbits a point, z up; the conventions of btfref/scene/description.py.
class Camera {
  constructor(shape) {
    this.look(shape);
  }

  look({ origin, target, fov, centre, radius }) {
    const offset = sum(origin, scaled(target, -1));
    this.distance = Math.hypot(...offset);
    [this.azimuth, this.elevation] = angles(unit(offset));
    Object.assign(this, { target, fov, centre, radius });
  }

  orbit(right, up) {
    this.azimuth -= right;
    this.elevation = clamp(this.elevation + up, -89, 89);
  }

  zoom(factor) {
    this.distance = clamp(this.distance * factor, 0.05 * this.radius, 20 * this.radius);
  }

  get origin() {
    return sum(this.target, scaled(direction(this.azimuth, this.elevation), this.distance));
  }

  axes() {
    const forward = scaled(direction(this.azimuth, this.elevation), -1);
    const left = unit(cross([0, 0, 1], forward));
    return { forward, left, up: cross(forward, left) };
  }

  // The shorter side of a picture has the field of view.
  tangents(width, height) {
    const tangent = Math.tan(0.5 * this.fov * RADIANS) / Math.min(width, height);
    return [tangent * width, tangent * height];
  }

  // Uniforms of a picture whose samples are at an offset from the pixels' top left corners.
  uniforms(width, height, offset) {
    const { forward, left, up } = this.axes(), origin = this.origin, [x, y] = this.tangents(width, height);
    const depth = dot(sum(this.centre, scaled(origin, -1)), forward);
    const near = Math.max(1e-3 * this.radius, depth - 1.01 * this.radius), far = Math.max(depth + 1.01 * this.radius, 2 * near);
    const shift = [(2 * (0.5 - offset[0])) / width, (-2 * (0.5 - offset[1])) / height];
    const rows = [
      sum(scaled(left, -1 / x), scaled(forward, shift[0])),
      sum(scaled(up, 1 / y), scaled(forward, shift[1])),
      scaled(forward, (far + near) / (far - near)),
      forward,
    ];
    const last = rows.map((row) => -dot(row, origin));
    last[2] -= (2 * far * near) / (far - near);
    return {
      world_to_clip: [0, 1, 2].flatMap((column) => rows.map((row) => row[column])).concat(last),
      camera_origin: origin,
      ray_corner: sum(forward, scaled(left, x), scaled(up, y)),
      ray_right: scaled(left, (-2 * x) / width),
      ray_down: scaled(up, (-2 * y) / height),
      film_offset: [offset[0] - 0.5, offset[1] - 0.5],
      film_height: height,
    };
  }

  // Where a point is in a picture, in its widths and heights from the top left.
  place(point, width, height) {
    const { forward, left, up } = this.axes(), offset = sum(point, scaled(this.origin, -1));
    const [x, y] = this.tangents(width, height), depth = dot(offset, forward);
    return [0.5 - dot(offset, left) / depth / x / 2, 0.5 - dot(offset, up) / depth / y / 2];
  }
}
