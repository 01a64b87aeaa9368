// Shapes of the room: triangles with normals, and line segments. Metres; of bodies x right, y down, z ahead, of all
// else z up.

// Faces of a convex solid: loops of corners, counter-clockwise from outside, to triangles [position, normal].
function solid(faces) {
    const out = [];
    for (const corners of faces) {
        const [a, b, c] = corners;
        const [u, v] = [b, c].map((p) => p.map((value, i) => value - a[i]));
        const n = [u[1] * v[2] - u[2] * v[1], u[2] * v[0] - u[0] * v[2], u[0] * v[1] - u[1] * v[0]];
        const length = Math.hypot(...n);
        const normal = n.map((value) => value / length);
        for (let k = 2; k < corners.length; k++) {
            for (const p of [a, corners[k - 1], corners[k]]) out.push(...p, ...normal);
        }
    }
    return new Float32Array(out);
}

function ring(radius, height, sides = 32) {
    return Array.from({ length: sides }, (_, k) => {
        const angle = (2 * Math.PI * k) / sides;
        return [radius * Math.cos(angle), radius * Math.sin(angle), height];
    });
}

// Between two loops of as many corners; the upper one first.
function wall(upper, lower) {
    return upper.map((p, k) => {
        const next = (k + 1) % upper.length;
        return [lower[k], lower[next], upper[next], p];
    });
}

const loop = (corners) => corners.flatMap((p, k) => [...p, ...corners[(k + 1) % corners.length]]);

export const CUBE_EDGE = 0.16;
const h = CUBE_EDGE / 2;
const top = [[-h, -h, h], [h, -h, h], [h, h, h], [-h, h, h]];
const bottom = top.map(([x, y]) => [x, y, -h]);

// The frustum of a headset's view, and the headset itself as a flat box.
const far = [[-0.13, -0.1, 0.22], [0.13, -0.1, 0.22], [0.13, 0.1, 0.22], [-0.13, 0.1, 0.22]];
const eye = [0, 0, 0];
const visor = [[-0.09, -0.045, 0.03], [0.09, -0.045, 0.03], [0.09, 0.045, 0.03], [-0.09, 0.045, 0.03]];
const back = visor.map(([x, y]) => [x, y, -0.05]);

// A TurtleBot 4: 34 cm wide; origin on the floor, x ahead.
const [deck, base] = [ring(0.17, 0.12), ring(0.17, 0.02)];
const mast = [[-0.11, -0.07], [-0.05, -0.07], [-0.05, 0.07], [-0.11, 0.07]];
const [mastTop, mastFoot] = [0.3, 0.12].map((z) => mast.map(([x, y]) => [x, y, z]));
const arrowHead = [[0.5, 0, 0.02], [0.3, 0.11, 0.02], [0.3, -0.11, 0.02]];
const arrowShaft = [[0.3, 0.04, 0.02], [0.2, 0.04, 0.02], [0.2, -0.04, 0.02], [0.3, -0.04, 0.02]];

const pin = ring(0.045, 0.42, 24);
const pinSides = (apex) => pin.map((p, k) => [p, pin[(k + 1) % pin.length], apex]);

const reversed = (corners) => [...corners].reverse();

export const SOLIDS = {
    cube: solid([top, reversed(bottom), ...wall(top, bottom)]),
    frustum: solid(far.map((p, k) => [eye, p, far[(k + 1) % 4]])),
    visor: solid([visor, reversed(back), ...wall(visor, back)]),
    robot: solid([deck, ...wall(deck, base), mastTop, ...wall(mastTop, mastFoot)]),
    arrow: solid([arrowHead, arrowShaft]),
    pin: solid([...pinSides([0, 0, 0.06]).map(reversed), ...pinSides([0, 0, 0.5])]),
    disc: solid([ring(0.2, 0.004)]),
    dot: solid([ring(1, 0)]),
};

export const LINES = {
    cube: [...loop(top), ...loop(bottom), ...top.flatMap((p, k) => [...p, ...bottom[k]])],
    frustum: [...loop(far), ...far.flatMap((p) => [...eye, ...p])],
    robot: [...loop(deck)],
    ring: loop(ring(0.2, 0.006)),
    ray: [0, 0, 0, 0, 0, -1],
    grid: Array.from({ length: 41 }, (_, k) => k - 20).flatMap((k) => [k, -20, 0, k, 20, 0, -20, k, 0, 20, k, 0]),
};
