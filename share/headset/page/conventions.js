// Between SHARE's axes and WebXR's: examples/conventions.json, "webxr". A test holds these against it. Rows.
// SHARE's map: x ahead at the start, y left, z up; its body: x right, y down, z ahead. WebXR: x right, y up, z back.
import { fromRows } from "./math.js";

const WORLD = [[0, -1, 0], [0, 0, 1], [-1, 0, 0]];
const BODY = [[1, 0, 0], [0, -1, 0], [0, 0, -1]];

const withoutShift = (rows) => fromRows([...rows.flatMap((row) => [...row, 0]), 0, 0, 0, 1]);

// A map seen in WebXR's axes about its own origin: of the preview, and where nothing is aligned yet.
export const T_xr_map = withoutShift(WORLD);
// The mount without a calibration: the viewer where the device is. BODY is its own inverse.
export const T_body_viewer_nominal = withoutShift(BODY);
