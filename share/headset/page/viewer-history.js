// Poses of the viewer in the headset's own space, of the last seconds, by the time that they are of.
import { fromPose, quaternionOf, slerp } from "./math.js";

const KEPT = 256;  // two seconds at 120 Hz
// Interpolation errs by half the acceleration times the product of the times to both poses: 2.5e-3 s^2 is the
// middle of 100 ms, or 10 ms beside a pose of 260 ms, with a page that draws few frames.
const MAX_PRODUCT_MS2 = 2500;
const MAX_GAP_MS = 300;  // between two poses

export class ViewerHistory {
    #times = new Float64Array(KEPT);
    #positions = new Float64Array(3 * KEPT);
    #quaternions = new Float64Array(4 * KEPT);
    #count = 0;
    #position = new Float64Array(3);
    #quaternion = new Float64Array(4);

    add(timeMs, T_local_viewer) {
        if (this.#count > 0 && timeMs <= this.#times[(this.#count - 1) % KEPT]) return;
        const k = this.#count++ % KEPT;
        this.#times[k] = timeMs;
        this.#positions.set(T_local_viewer.subarray(12, 15), 3 * k);
        quaternionOf(this.#quaternion, T_local_viewer);
        this.#quaternions.set(this.#quaternion, 4 * k);
    }

    forget() {
        this.#count = 0;
    }

    // Whether a pose of `timeMs` may still come to lie between two.
    isBefore(timeMs) {
        return this.#count === 0 || this.#times[(this.#count - 1) % KEPT] < timeMs;
    }

    // T_local_viewer at a time, between the two poses about it; null outside or in a gap.
    at(timeMs) {
        const [i, j] = this.#about(timeMs);
        if (i === null) return null;
        const gapMs = this.#times[j] - this.#times[i];
        const product = (timeMs - this.#times[i]) * (this.#times[j] - timeMs);
        if (gapMs > MAX_GAP_MS || product > MAX_PRODUCT_MS2) return null;
        const share = (timeMs - this.#times[i]) / gapMs;
        for (let c = 0; c < 3; c++) {
            const from = this.#positions[3 * i + c];
            this.#position[c] = from + share * (this.#positions[3 * j + c] - from);
        }
        const ends = [i, j].map((k) => this.#quaternions.subarray(4 * k, 4 * k + 4));
        slerp(this.#quaternion, ...ends, share);
        return fromPose(new Float64Array(16), this.#position, this.#quaternion);
    }

    // How fast the viewer turns and moves at a time, between the two poses about it; 0 outside.
    speedsAt(timeMs) {
        const [i, j] = this.#about(timeMs);
        if (i === null) return { radPerS: 0, mPerS: 0 };
        const seconds = (this.#times[j] - this.#times[i]) / 1000;
        const [p, q] = [i, j].map((k) => this.#positions.subarray(3 * k, 3 * k + 3));
        const [a, b] = [i, j].map((k) => this.#quaternions.subarray(4 * k, 4 * k + 4));
        const cosine = Math.abs(a[0] * b[0] + a[1] * b[1] + a[2] * b[2] + a[3] * b[3]);
        const rad = 2 * Math.acos(Math.min(cosine, 1));
        return { radPerS: rad / seconds, mPerS: Math.hypot(q[0] - p[0], q[1] - p[1], q[2] - p[2]) / seconds };
    }

    // The indices of the two poses about a time; nulls outside.
    #about(timeMs) {
        for (let n = this.#count - 1; n > 0 && n > this.#count - KEPT; n--) {
            const [i, j] = [(n - 1) % KEPT, n % KEPT];
            if (this.#times[i] <= timeMs) return this.#times[j] < timeMs ? [null, null] : [i, j];
        }
        return [null, null];
    }
}
