// Names, units, and numbers with a true minus sign.

export const NAMES = {
  height_m: ["Height", "m", 4],
  pitch_deg: ["Pitch", "°", 3],
  radius_px: ["Radius", "px", 2],
  cx: ["Centre, across", "px", 2],
  cy: ["Centre, down", "px", 2],
  heading_deg: ["Heading", "°", 3],
};
export const HINTS = {
  height_m: "of the lens above the ground",
  pitch_deg: "0 looks level, negative looks down",
  radius_px: "of the lens circle, in pixels of the square crop",
  heading_deg: "turns the grid to the right of where the camera looks",
};
export const FIRST = ["height_m", "pitch_deg", "radius_px"];

export const rounded = (key, value) => Number(value.toFixed(NAMES[key][2]));
export const minus = (text) => text.replace("-", "−");
export function sign(value, digits) {
  const size = Math.abs(value).toFixed(digits);
  return Number(size) === 0 ? size : `${value < 0 ? "−" : "+"}${size}`;
}
export const unitOf = (key) => (NAMES[key][1] === "°" ? "°" : ` ${NAMES[key][1]}`);
