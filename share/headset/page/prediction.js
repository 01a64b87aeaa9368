// Where a head will be when a frame is shown: tests/helpers/headset_reference.py in JavaScript.
import { exp, multiply } from "./math.js";

export const MAX_AHEAD_S = 0.1;  // beyond, a head has turned otherwise

const turn = new Float64Array(16);
const xi = new Float64Array(6);

// T_world_body `aheadS` later, at most MAX_AHEAD_S. velocity m/s along the world's axes, angularVelocity rad/s about
// the body's.
export function predictPose(out, T_world_body, velocity, angularVelocity, aheadS) {
    const ahead = Math.min(Math.max(aheadS, 0), MAX_AHEAD_S);
    for (let i = 0; i < 3; i++) xi[i] = angularVelocity[i] * ahead;
    multiply(out, T_world_body, exp(turn, xi));
    for (let i = 0; i < 3; i++) out[12 + i] += velocity[i] * ahead;
    return out;
}
