// Two directional lights.
const TWO_LIGHTS = [
  { on: true, azimuth: -35, elevation: 50, stops: 0, colour: "#ffffff" },
  { on: false, azimuth: 150, elevation: 25, stops: -1, colour: "#ffd9b0" },
];

const decoded = (code) => (code <= 0.04045 ? code / 12.92 : ((code + 0.055) / 1.055) ** 2.4);

// Irradiance across the light's direction: π at 0 EV, so that radiance is B · π, and that of a white surface 1.
function irradiance(light) {
  const channels = [1, 3, 5].map((at) => decoded(parseInt(light.colour.slice(at, at + 2), 16) / 255));
  return scaled(channels, Math.PI * 2 ** light.stops);
}

// Rows of shaders/lib/light/lights.glsl: those that are on.
function lightTable(lights) {
  const table = new Float32Array(24);
  lights.filter((light) => light.on).forEach((light, i) => {
    table.set(direction(light.azimuth, light.elevation), 12 * i);
    table.set(irradiance(light), 12 * i + 4);
  });
  return table;
}

// A light follows the pointer: its direction moves across the screen, as if held on a ball.
function turnLight(light, camera, right, up) {
  const axes = camera.axes(), moved = sum(
    direction(light.azimuth, light.elevation), scaled(axes.left, -right * RADIANS), scaled(axes.up, up * RADIANS));
  [light.azimuth, light.elevation] = angles(unit(moved));
}
