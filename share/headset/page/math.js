// Rigid transforms as WebGL has them: 16 numbers, column by column; T_a_b takes b to a. Tangents are xi = (phi, rho),
// rotation before translation, on the right, as in share/geometry/se3.py. `out` may be one of the inputs.

export function identity(out = new Float64Array(16)) {
    out.fill(0);
    out[0] = out[5] = out[10] = out[15] = 1;
    return out;
}

// From and to the wire, which has rows.
export function fromRows(rows, out = new Float64Array(16)) {
    for (let i = 0; i < 4; i++) for (let j = 0; j < 4; j++) out[4 * j + i] = rows[4 * i + j];
    return out;
}

export function toRows(T) {
    return Array.from({ length: 16 }, (_, k) => T[4 * (k % 4) + (k >> 2)]);
}

const product = new Float64Array(16);

export function multiply(out, A, B) {
    for (let j = 0; j < 16; j += 4) {
        for (let i = 0; i < 4; i++) {
            product[j + i] = A[i] * B[j] + A[i + 4] * B[j + 1] + A[i + 8] * B[j + 2] + A[i + 12] * B[j + 3];
        }
    }
    out.set(product);
    return out;
}

export function inverse(out, T) {
    const [x, y, z] = [T[12], T[13], T[14]];
    product.set(T);
    for (let i = 0; i < 3; i++) {
        for (let j = 0; j < 3; j++) out[4 * j + i] = product[4 * i + j];
        out[12 + i] = -(product[4 * i] * x + product[4 * i + 1] * y + product[4 * i + 2] * z);
        out[4 * i + 3] = 0;
    }
    out[15] = 1;
    return out;
}

export function transformPoint(out, T, p) {
    const [x, y, z] = p;
    for (let i = 0; i < 3; i++) out[i] = T[i] * x + T[i + 4] * y + T[i + 8] * z + T[i + 12];
    return out;
}

export function rotate(out, T, v) {
    const [x, y, z] = v;
    for (let i = 0; i < 3; i++) out[i] = T[i] * x + T[i + 4] * y + T[i + 8] * z;
    return out;
}

// A perspective of the vertical field of view, rad, that looks along -z.
export function perspective(out, fovY, aspect, near, far) {
    out.fill(0);
    out[5] = 1 / Math.tan(fovY / 2);
    out[0] = out[5] / aspect;
    out[10] = (far + near) / (near - far);
    out[11] = -1;
    out[14] = (2 * far * near) / (near - far);
    return out;
}

// ---------------------------------------------------------------- quaternions, x y z w

// From a position and a quaternion, which need not be normalised.
export function fromPose(out, position, quaternion) {
    const [x, y, z, w] = quaternion;
    const s = 2 / (x * x + y * y + z * z + w * w);
    out[0] = 1 - s * (y * y + z * z);
    out[1] = s * (x * y + w * z);
    out[2] = s * (x * z - w * y);
    out[4] = s * (x * y - w * z);
    out[5] = 1 - s * (x * x + z * z);
    out[6] = s * (y * z + w * x);
    out[8] = s * (x * z + w * y);
    out[9] = s * (y * z - w * x);
    out[10] = 1 - s * (x * x + y * y);
    out[12] = position[0];
    out[13] = position[1];
    out[14] = position[2];
    out[3] = out[7] = out[11] = 0;
    out[15] = 1;
    return out;
}

// By the largest of its components (Shepperd, 1978); w >= 0.
export function quaternionOf(out, T) {
    const trace = T[0] + T[5] + T[10];
    const squares = [1 + 2 * T[0] - trace, 1 + 2 * T[5] - trace, 1 + 2 * T[10] - trace, 1 + trace];
    const k = squares.indexOf(Math.max(...squares));
    const d = 2 * Math.sqrt(squares[k]);
    if (k === 3) {
        out[0] = (T[6] - T[9]) / d;
        out[1] = (T[8] - T[2]) / d;
        out[2] = (T[1] - T[4]) / d;
        out[3] = d / 4;
    } else {
        const [i, j] = [(k + 1) % 3, (k + 2) % 3];
        out[k] = d / 4;
        out[i] = (T[4 * k + i] + T[4 * i + k]) / d;
        out[j] = (T[4 * k + j] + T[4 * j + k]) / d;
        out[3] = (T[4 * i + j] - T[4 * j + i]) / d;
    }
    if (out[3] < 0) for (let i = 0; i < 4; i++) out[i] = -out[i];
    return out;
}

// Between a and b by the shorter way; share 0 is a, 1 is b.
export function slerp(out, a, b, share) {
    const dot = a[0] * b[0] + a[1] * b[1] + a[2] * b[2] + a[3] * b[3];
    const angle = Math.acos(Math.min(Math.abs(dot), 1));
    const isSmall = angle < 1e-6;
    const from = isSmall ? 1 - share : Math.sin((1 - share) * angle) / Math.sin(angle);
    const to = (isSmall ? share : Math.sin(share * angle) / Math.sin(angle)) * (dot < 0 ? -1 : 1);
    for (let i = 0; i < 4; i++) out[i] = from * a[i] + to * b[i];
    return out;
}

const quaternion = new Float64Array(4);

// The rotation nearest to what repeated products have left.
export function orthonormal(out, T) {
    return fromPose(out, [T[12], T[13], T[14]], quaternionOf(quaternion, T));
}

// ---------------------------------------------------------------- SE(3)

const SMALL = 1e-4;  // rad; below, Taylor series

function coefficients(a) {
    if (a < SMALL) return [1 - (a * a) / 6, 0.5 - (a * a) / 24, 1 / 6 - (a * a) / 120];
    return [Math.sin(a) / a, (1 - Math.cos(a)) / (a * a), (a - Math.sin(a)) / (a * a * a)];
}

// out = v + first K v + second K K v, with K v = phi x v
function series(out, phi, v, first, second) {
    const [x, y, z] = phi;
    const [a, b, c] = [y * v[2] - z * v[1], z * v[0] - x * v[2], x * v[1] - y * v[0]];
    const [p, q, r] = v;
    out[0] = p + first * a + second * (y * c - z * b);
    out[1] = q + first * b + second * (z * a - x * c);
    out[2] = r + first * c + second * (x * b - y * a);
    return out;
}

const AXES = [[1, 0, 0], [0, 1, 0], [0, 0, 1]];
const column = new Float64Array(3);

export function exp(out, xi) {
    const phi = [xi[0], xi[1], xi[2]];
    const [A, B, C] = coefficients(Math.hypot(...phi));
    identity(out);
    for (let j = 0; j < 3; j++) out.set(series(column, phi, AXES[j], A, B), 4 * j);
    out.set(series(column, phi, [xi[3], xi[4], xi[5]], B, C), 12);
    return out;
}

export function log(T) {
    const q = quaternionOf(quaternion, T);
    const n = Math.hypot(q[0], q[1], q[2]);
    const scale = n < 1e-9 ? 2 : (2 * Math.atan2(n, q[3])) / n;
    const phi = [q[0] * scale, q[1] * scale, q[2] * scale];
    const a = Math.hypot(...phi);
    const [A, B] = coefficients(a);
    const second = a < SMALL ? 1 / 12 + (a * a) / 720 : (1 - A / (2 * B)) / (a * a);
    return [...phi, ...series(column, phi, [T[12], T[13], T[14]], -0.5, second)];
}

// Ad (6, 6) row by row, with T Exp(xi) = Exp(Ad xi) T.
export function adjoint(T) {
    const out = new Float64Array(36);
    for (let j = 0; j < 3; j++) {
        const [x, y, z] = [T[4 * j], T[4 * j + 1], T[4 * j + 2]];
        const lower = [T[13] * z - T[14] * y, T[14] * x - T[12] * z, T[12] * y - T[13] * x];
        for (let i = 0; i < 3; i++) {
            out[6 * i + j] = out[6 * (i + 3) + j + 3] = T[4 * j + i];
            out[6 * (i + 3) + j] = lower[i];
        }
    }
    return out;
}

// ---------------------------------------------------------------- matrices (6, 6), row by row

export function product6(A, B) {
    const out = new Float64Array(36);
    for (let i = 0; i < 6; i++) {
        for (let k = 0; k < 6; k++) {
            for (let j = 0; j < 6; j++) out[6 * i + j] += A[6 * i + k] * B[6 * k + j];
        }
    }
    return out;
}

export function apply6(A, v) {
    return Float64Array.from({ length: 6 }, (_, i) => {
        let sum = 0;
        for (let j = 0; j < 6; j++) sum += A[6 * i + j] * v[j];
        return sum;
    });
}

export function transposed6(A) {
    return A.map((_, k) => A[6 * (k % 6) + Math.floor(k / 6)]);
}

// A C A'
export function congruence6(A, C) {
    return product6(product6(A, C), transposed6(A));
}

// S^-1 B of a positive definite S (6, 6) and B (6, n), by Cholesky.
export function solve6(S, B) {
    const n = B.length / 6;
    const L = new Float64Array(36);
    const out = Float64Array.from(B);
    for (let i = 0; i < 6; i++) {
        for (let j = 0; j <= i; j++) {
            let sum = S[6 * i + j];
            for (let k = 0; k < j; k++) sum -= L[6 * i + k] * L[6 * j + k];
            L[6 * i + j] = i === j ? Math.sqrt(sum) : sum / L[6 * j + j];
        }
    }
    for (let c = 0; c < n; c++) {
        for (let i = 0; i < 6; i++) {
            for (let k = 0; k < i; k++) out[n * i + c] -= L[6 * i + k] * out[n * k + c];
            out[n * i + c] /= L[7 * i];
        }
        for (let i = 5; i >= 0; i--) {
            for (let k = i + 1; k < 6; k++) out[n * i + c] -= L[6 * k + i] * out[n * k + c];
            out[n * i + c] /= L[7 * i];
        }
    }
    return out;
}
