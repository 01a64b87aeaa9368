// Where the room is, seen from the headset: T_map_local of each frame, in one of two modes.
//   align   the headset tracks itself; SHARE says, filtered, where its space is in the map
//   follow  the wearer is where SHARE's newest pose says, predicted to the time of display: its latency is seen; where
//           no pose comes, what is drawn is held by the headset's own tracking
// Where it jumps (maps joined, the space aligned anew, the other way to draw) what is drawn eases over EASE_MS.
import { PairOutcome, SpaceAlignment } from "./alignment.js";
import { T_body_viewer_nominal } from "./conventions.js";
import { exp, identity, inverse, log, multiply } from "./math.js";
import { predictPose } from "./prediction.js";
import { ViewerHistory } from "./viewer-history.js";

export const EASE_MS = 500;
const MAX_AGE_MS = 1000;  // of a pose that is followed
const [AGAIN_AGE_MS, AGAIN_MS] = [700, 2000];  // once one was older: of all poses, for so long, until they are followed again
const NEWS_MS = 500;  // without another pose none comes
const MAX_WAITING = 8;  // poses that are newer than the viewer's
const MAX_TIMESHIFT_MS = 200;  // of a mount; beyond, its recording was of clocks that have nothing in common
const JUDGED = 100;  // pairs, by which the mount is judged
const MAX_REFUSED_SHARE = 0.1;  // a mount that is 2 degrees wrong exceeds it
const DRIFT_MS = 10000;  // over which drift is taken
const STILL = [0, 0, 0];

// 1 at the start of an ease, 0 at its end.
export function easeLeft(sinceMs) {
    const s = Math.min(Math.max(sinceMs / EASE_MS, 0), 1);
    return 1 - s * s * (3 - 2 * s);
}

// The covariance (6, 6) of a pose whose time is known by so much, of a head that moves at {radPerS, mPerS}.
function covAtTime(cov, { radPerS, mPerS }, timeSigmaMs) {
    const out = Float64Array.from(cov);
    for (let i = 0; i < 6; i++) out[7 * i] += (((i < 3 ? radPerS : mPerS) * timeSigmaMs) / 1000) ** 2;
    return out;
}

export class Placement {
    mode = "align";  // as the wearer wants it
    isFollowing = false;  // as it is drawn
    isPredicting = true;  // in follow
    mapId = null;  // of what is drawn; null: the headset's place is not known
    T_map_local = identity();  // as drawn
    alignment = null;
    history = new ViewerHistory();
    #pose = null;  // the newest of the own device, {timeMs, mapId, T_map_body, cov, velocity, angularVelocity}
    #waiting = [];
    #poses = { heardMs: -Infinity, last: null, youngSinceMs: null, areOld: false };  // of the own device, frame by frame
    #hasJumped = null;  // why
    #ease = null;  // {xi, beganMs}
    #refused = [];
    #earlier = [];  // {timeMs, T_map_local} each second, by which drift is taken
    #target = identity();
    #scratch = identity();
    #viewerTarget = identity();

    // onNotice: told in words what moves what is drawn.
    constructor(onNotice = () => {}) {
        this.onNotice = onNotice;
        this.setMount(null, 0);
    }

    // T_body_viewer: null where none was calibrated. timeshiftMs: the device's clock less the headset's. The same mount
    // again, as after a reconnection, changes nothing.
    setMount(T_body_viewer, timeshiftMs) {
        const mount = T_body_viewer ?? T_body_viewer_nominal;
        this.isCalibrated = T_body_viewer !== null;
        this.timeshiftMs = Math.abs(timeshiftMs ?? 0) <= MAX_TIMESHIFT_MS ? (timeshiftMs ?? 0) : 0;
        if (this.alignment?.T_body_viewer.every((value, k) => value === mount[k])) return;
        this.alignment = new SpaceAlignment(mount);
    }

    setMode(mode) {
        this.mode = mode;
        this.#poses.areOld = false;
    }

    // Whether the wearer wants to follow poses, and none is new enough.
    get isHeld() {
        return this.mode === "follow" && !this.isFollowing;
    }

    // Why, in words.
    whyHeld(nowMs) {
        if (!(nowMs - this.#poses.heardMs <= NEWS_MS)) return "no new pose";
        return `poses ${this.poseAgeMs(nowMs) > MAX_AGE_MS ? "are" : "were"} over 1 s old`;
    }

    // A pose of the own device; timeMs: of its stamp on the page's clock, timeSigmaMs: of that.
    addPose(pose) {
        this.#pose = { ...pose, timeMs: pose.timeMs - this.timeshiftMs };
        this.#waiting.push(this.#pose);
        if (this.#waiting.length > MAX_WAITING) this.#waiting.shift();
    }

    // The headset's own space was reset: what is known of it holds no longer.
    reset() {
        this.history.forget();
        this.#waiting = [];
        this.#earlier = [];
        this.#ease = null;
        this.alignment = this.alignment.forgotten();
        this.mapId = null;
        this.onNotice("recentred: finding this headset in the room again");
    }

    // A map was joined to another.
    joined(oldId, newId, T_new_old) {
        if (this.alignment.mapId === oldId) this.alignment = this.alignment.joined(newId, T_new_old);
        for (const pose of [...this.#waiting, this.#pose]) {
            if (pose?.mapId !== oldId) continue;
            pose.mapId = newId;
            pose.T_map_body = multiply(new Float64Array(16), T_new_old, pose.T_map_body);
        }
        if (this.mapId !== oldId) return;
        multiply(this.T_map_local, T_new_old, this.T_map_local);
        this.mapId = newId;
        this.#earlier = [];
        this.#hasJumped = "maps were joined";
    }

    // Bring what is drawn up to date for a frame. timeMs: which T_local_viewer is of, and when it is shown.
    update(timeMs, T_local_viewer) {
        this.history.add(timeMs, T_local_viewer);
        this.#pairWaiting();
        this.#chooseWay(timeMs);
        const mapId = this.isFollowing ? this.#follow(timeMs, T_local_viewer) : this.#align();
        if (mapId === null) {
            this.mapId = null;
            return;
        }
        this.#show(mapId, timeMs, T_local_viewer);
        this.#noteDrift(timeMs);
    }

    // Age of the newest pose of the own device, ms; null without one.
    poseAgeMs(nowMs) {
        return this.#pose && nowMs - this.#pose.timeMs;
    }

    // One sigma of where the alignment puts the wearer, mm; null before a pair.
    sigmaMm(T_local_viewer) {
        if (this.alignment.T_map_local === null) return null;
        const cov = this.alignment.covAt(T_local_viewer);
        return 1000 * Math.sqrt(Math.max(cov[21] + cov[28] + cov[35], 0));
    }

    // By how much the alignment moves at a viewer, mm/s over the last ten seconds; null before two.
    driftMmS(T_local_viewer, nowMs) {
        const then = this.#earlier.at(0);
        if (this.alignment.T_map_local === null || !then || nowMs - then.timeMs < 2000) return null;
        const p = T_local_viewer.subarray(12, 15);
        const moved = [0, 1, 2].map((i) => {
            const difference = (k) => this.alignment.T_map_local[k] - then.T_map_local[k];
            return difference(i) * p[0] + difference(i + 4) * p[1] + difference(i + 8) * p[2] + difference(i + 12);
        });
        return (1000 * Math.hypot(...moved)) / ((nowMs - then.timeMs) / 1000);
    }

    // Whether the pairs contradict each other, as those of a wrong mount do.
    get isContradicted() {
        const refused = this.#refused.filter(Boolean).length;
        return this.#refused.length === JUDGED && refused > MAX_REFUSED_SHARE * JUDGED;
    }

    #pairWaiting() {
        while (this.#waiting.length > 0 && !this.history.isBefore(this.#waiting[0].timeMs)) {
            const pose = this.#waiting.shift();
            const T_local_viewer = this.history.at(pose.timeMs);
            if (T_local_viewer === null) continue;
            const { mapId, T_map_body } = pose;
            const cov = covAtTime(pose.cov, this.history.speedsAt(pose.timeMs), pose.timeSigmaMs ?? 0);
            const pair = { timeS: pose.timeMs / 1000, mapId, T_map_body, cov, T_local_viewer };
            const [alignment, outcome] = this.alignment.after(pair);
            this.alignment = alignment;
            this.#refused.push(outcome === PairOutcome.REFUSED);
            if (this.#refused.length > JUDGED) this.#refused.shift();
            if (outcome === PairOutcome.RESTARTED || outcome === PairOutcome.STARTED) {
                this.#earlier = [];
                if (!this.isFollowing) this.#hasJumped = "the headset's space was aligned anew";
            }
        }
    }

    #chooseWay(timeMs) {
        this.#judgeAge(timeMs);
        const isFollowing = this.mode === "follow" && !this.#poses.areOld;
        if (isFollowing === this.isFollowing) return;
        this.isFollowing = isFollowing;
        if (isFollowing) this.#hasJumped = "drawn by SHARE's newest pose";
        else this.#hasJumped = `${this.isHeld ? `${this.whyHeld(timeMs)}: ` : ""}drawn by the headset's tracking`;
    }

    // Poses that are about as old as they may be would else be followed and not, in turns.
    #judgeAge(timeMs) {
        const [poses, pose] = [this.#poses, this.#pose];
        if (pose !== poses.last) [poses.last, poses.heardMs] = [pose, timeMs];
        const ageMs = pose === null ? Infinity : timeMs - pose.timeMs;
        if (ageMs > AGAIN_AGE_MS) poses.youngSinceMs = null;
        else poses.youngSinceMs ??= timeMs;
        const areYoung = poses.youngSinceMs !== null && timeMs - poses.youngSinceMs >= AGAIN_MS;
        poses.areOld = poses.areOld ? !areYoung : ageMs > MAX_AGE_MS;
    }

    #align() {
        if (this.alignment.T_map_local === null) return null;
        this.#target.set(this.alignment.T_map_local);
        return this.alignment.mapId;
    }

    #follow(timeMs, T_local_viewer) {
        const pose = this.#pose;
        const aheadS = this.isPredicting ? (timeMs - pose.timeMs) / 1000 : 0;
        predictPose(this.#target, pose.T_map_body, pose.velocity ?? STILL, pose.angularVelocity ?? STILL, aheadS);
        multiply(this.#target, this.#target, this.alignment.T_body_viewer);
        multiply(this.#target, this.#target, inverse(this.#scratch, T_local_viewer));
        return pose.mapId;
    }

    // At the wearer, where a jump is seen: the lever arm to either origin would exaggerate it.
    #show(mapId, timeMs, T_local_viewer) {
        const viewerTarget = multiply(this.#viewerTarget, this.#target, T_local_viewer);
        if (mapId !== this.mapId) {
            this.#ease = this.#hasJumped = null;  // nothing of it was drawn before
        } else if (this.#hasJumped !== null) {
            const shown = multiply(new Float64Array(16), this.T_map_local, T_local_viewer);
            const xi = log(multiply(shown, inverse(new Float64Array(16), viewerTarget), shown));
            this.#ease = { xi, beganMs: timeMs };
            this.#tell(xi);
            this.#hasJumped = null;
        }
        const left = this.#ease === null ? 0 : easeLeft(timeMs - this.#ease.beganMs);
        if (left > 0) {
            multiply(viewerTarget, viewerTarget, exp(this.#scratch, this.#ease.xi.map((value) => value * left)));
            multiply(this.T_map_local, viewerTarget, inverse(this.#scratch, T_local_viewer));
        } else {
            this.#ease = null;
            this.T_map_local.set(this.#target);
        }
        this.mapId = mapId;
    }

    #tell(xi) {
        const cm = 100 * Math.hypot(xi[3], xi[4], xi[5]);
        const degrees = (180 / Math.PI) * Math.hypot(xi[0], xi[1], xi[2]);
        const size = `${cm.toFixed(1)} cm and ${degrees.toFixed(1)}°`;
        this.onNotice(`${this.#hasJumped}; all moves by ${size} within ${EASE_MS / 1000} s`);
    }

    #noteDrift(timeMs) {
        if (this.alignment.T_map_local === null) return;
        if (this.#earlier.length > 0 && timeMs - this.#earlier.at(-1).timeMs < 1000) return;
        this.#earlier.push({ timeMs, T_map_local: this.alignment.T_map_local });
        while (timeMs - this.#earlier[0].timeMs > DRIFT_MS) this.#earlier.shift();
    }
}
