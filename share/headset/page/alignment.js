// Where a headset's own space is in the shared map: tests/helpers/headset_reference.py in JavaScript, held to the same vectors.
// Local and viewer are in WebXR's axes; T_body_viewer, the mount, takes care of the rest.
import { adjoint, apply6, congruence6, exp, inverse, log, multiply, orthonormal, product6, solve6 } from "./math.js";

const radians = (degrees) => (degrees * Math.PI) / 180;
const squared = (rotation, translation) => [0, 1, 2, 3, 4, 5].map((k) => (k < 3 ? rotation : translation) ** 2);

const WALK = squared(radians(0.03), 0.003);  // random walk at the wearer, rad and m in the root of a second, squared
const TREMBLE = squared(radians(0.05), 0.001);  // of headset poses
const CORRELATION_S = 2.0;  // how long errors of map poses last
const USUAL_SIGMA = { rad: 0.004, m: 0.01 };  // of a pose that names none, of three axes together
const LEAST_SIGMA = { rad: 0.002, m: 0.005 };  // an agent knows no better than this what its camera and IMU do
const MAX_NIS = 40.0;  // of a pair, 6 degrees of freedom, as if errors did not last
const MAX_REFUSED_S = 1.0;  // of refused pairs in a row, after which they are right

export const PairOutcome = Object.freeze({
    STARTED: "started",  // the first one: what is drawn jumps to its place
    USED: "used",
    REFUSED: "refused",  // it contradicts the alignment
    RESTARTED: "restarted",  // those refused agree with each other: what is drawn jumps
});

const times = (A, B) => multiply(new Float64Array(16), A, B);
const inverted = (T) => inverse(new Float64Array(16), T);
const plusDiagonal = (A, diagonal, scale = 1) => {
    const out = Float64Array.from(A);
    for (let i = 0; i < 6; i++) out[7 * i] += diagonal[i] * scale;
    return out;
};

// The covariance (6, 6) of a pose in the map by what its agent says, of three axes together; null: it does not say.
export function poseCov(sigmaM, sigmaRad) {
    const sigmas = [
        Math.max(sigmaRad ?? USUAL_SIGMA.rad, LEAST_SIGMA.rad),
        Math.max(sigmaM ?? USUAL_SIGMA.m, LEAST_SIGMA.m),
    ];
    const cov = new Float64Array(36);
    for (let i = 0; i < 6; i++) cov[7 * i] = sigmas[i < 3 ? 0 : 1] ** 2 / 3;
    return cov;
}

// T_map_local with cov (6, 6), perturbed on the left in the map; null before a pair.
export class SpaceAlignment {
    constructor(T_body_viewer) {
        this.T_body_viewer = T_body_viewer;
        this.mapId = this.T_map_local = this.cov = this.refusedSinceS = null;
        this.timeS = 0;
    }

    // The alignment after a pair {timeS, mapId, T_map_body, cov, T_local_viewer}, and what became of the pair.
    after(pair) {
        if (this.T_map_local === null || this.mapId !== pair.mapId) return [this.#started(pair), PairOutcome.STARTED];
        const elapsedS = Math.max(pair.timeS - this.timeS, 0);
        const P = times(this.T_map_local, pair.T_local_viewer);
        const innovation = log(times(inverted(P), times(pair.T_map_body, this.T_body_viewer)));
        const prior = plusDiagonal(this.covAt(pair.T_local_viewer), WALK, elapsedS);
        const noise = this.#pairNoise(pair);
        const scaled = solve6(prior.map((value, k) => value + noise[k]), innovation);
        if (innovation.reduce((sum, value, k) => sum + value * scaled[k], 0) > MAX_NIS) return this.#refused(pair);
        const lasting = Math.max(1, CORRELATION_S / Math.max(elapsedS, 1e-3));
        const sum = prior.map((value, k) => value + noise[k] * lasting);
        const step = apply6(prior, solve6(sum, innovation));  // gain innovation
        const used = product6(prior, solve6(sum, prior));  // gain prior
        const moved = times(P, exp(new Float64Array(16), step));
        return [
            this.#with({
                T_map_local: orthonormal(new Float64Array(16), times(moved, inverted(pair.T_local_viewer))),
                cov: congruence6(adjoint(P), prior.map((value, k) => value - used[k])),
                timeS: pair.timeS,
                refusedSinceS: null,
            }),
            PairOutcome.USED,
        ];
    }

    // The covariance (6, 6) of T_map_local at a viewer, perturbed on its right.
    covAt(T_local_viewer) {
        return congruence6(adjoint(inverted(times(this.T_map_local, T_local_viewer))), this.cov);
    }

    // Before any pair: the headset's space was reset.
    forgotten() {
        return new SpaceAlignment(this.T_body_viewer);
    }

    // In the map that `mapId` was joined to.
    joined(mapId, T_new_old) {
        const cov = congruence6(adjoint(T_new_old), this.cov);
        return this.#with({ mapId, T_map_local: times(T_new_old, this.T_map_local), cov });
    }

    #with(changes) {
        return Object.assign(new SpaceAlignment(this.T_body_viewer), this, changes);
    }

    #started(pair) {
        const P = times(pair.T_map_body, this.T_body_viewer);
        return this.#with({
            mapId: pair.mapId,
            T_map_local: times(P, inverted(pair.T_local_viewer)),
            cov: congruence6(adjoint(P), this.#pairNoise(pair)),
            timeS: pair.timeS,
            refusedSinceS: null,
        });
    }

    #refused(pair) {
        const refusedSinceS = this.refusedSinceS ?? pair.timeS;
        if (pair.timeS - refusedSinceS >= MAX_REFUSED_S) return [this.#started(pair), PairOutcome.RESTARTED];
        return [this.#with({ refusedSinceS }), PairOutcome.REFUSED];
    }

    // The covariance (6, 6) of a pair, at the viewer.
    #pairNoise(pair) {
        return plusDiagonal(congruence6(adjoint(inverted(this.T_body_viewer)), pair.cov), TREMBLE);
    }
}
