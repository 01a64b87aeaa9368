// Poses of a SHARE agent for a web page (three.js, Babylon.js, plain WebXR), by WebSocket:
//     share agent realsense --name ann --kind ar --edge tcp://H:P --poses ws://127.0.0.1:5571
// A page from elsewhere than this machine needs --poses-origin https://its.origin.
//
//     import { SharePoses } from "./share-poses.js";
//     const poses = new SharePoses("ws://127.0.0.1:5571");
//     function render() {                       // each animation frame
//         const matrix = poses.matrix(12);      // of the device in the shared map, 12 ms from now, when the frame
//                                               // is shown; null while it is unknown
//         if (matrix) device.matrix.fromArray(matrix);   // three.js; device.matrixAutoUpdate = false
//     }

// examples/conventions.json, "webxr": a test holds these against it. Rows.
const WORLD = [[0, -1, 0], [0, 0, 1], [-1, 0, 0]];
const BODY = [[1, 0, 0], [0, -1, 0], [0, 0, -1]];

const MAX_AHEAD_MS = 100;  // beyond, a head has turned otherwise

export class SharePoses {
    // frame: "map", which all agents of a map_id share, or "odom", which never jumps within a segment.
    constructor(url, frame = "map") {
        this.url = url;
        this.frame = frame;
        this.message = null;  // the newest; docs/do/integrate.md says what is in it
        this.connect();
    }

    connect() {
        this.socket = new WebSocket(this.url);
        this.socket.onmessage = (event) => {
            const message = JSON.parse(event.data);
            if (message.schema !== 3) return;
            this.message = message;
            this.arrivedMs = performance.now();
        };
        this.socket.onclose = () => {
            this.message = null;
            if (!this.isClosed) setTimeout(() => this.connect(), 1000);
        };
    }

    close() {
        this.isClosed = true;
        this.socket.close();
    }

    // Where the device will be in `inMs`: carried on from its newest pose at constant velocity and turning rate.
    matrix(inMs = 0) {
        const message = this.message;
        if (!message || !message[this.frame]) return null;
        const pose = predictPose(message, this.frame, message.age_ms + performance.now() - this.arrivedMs + inMs);
        return toMatrix(pose.position, pose.quaternion);
    }
}

// The pose of a message in `frame`, `aheadMs` later than its stamp. Velocity comes along the axes of odom.
export function predictPose(message, frame, aheadMs) {
    const { position, quaternion } = message[frame];
    const { velocity, angular_velocity: turning, quaternion: inOdom } = message.odom;
    if (!velocity) return { position, quaternion };
    const seconds = Math.min(Math.max(aheadMs, 0), MAX_AHEAD_MS) / 1000;
    const [x, y, z, w] = inOdom;
    const along = rotate(quaternion, rotate([-x, -y, -z, w], velocity));
    return {
        position: position.map((value, i) => value + along[i] * seconds),
        quaternion: product(quaternion, fromRotation(turning.map((rate) => rate * seconds))),
    };
}

// 16 numbers, column by column as WebGL has them: WORLD T BODY^-1; BODY is its own inverse.
export function toMatrix(position, quaternion) {
    const columns = [0, 1, 2].map((j) => multiply(WORLD, rotate(quaternion, [BODY[0][j], BODY[1][j], BODY[2][j]])));
    const [x, y, z] = columns;
    return [...x, 0, ...y, 0, ...z, 0, ...multiply(WORLD, position), 1];
}

function multiply(m, v) {
    return m.map((row) => row[0] * v[0] + row[1] * v[1] + row[2] * v[2]);
}

// Hamilton's product, x y z w
function product([ax, ay, az, aw], [bx, by, bz, bw]) {
    return [
        aw * bx + ax * bw + ay * bz - az * by,
        aw * by - ax * bz + ay * bw + az * bx,
        aw * bz + ax * by - ay * bx + az * bw,
        aw * bw - ax * bx - ay * by - az * bz,
    ];
}

function fromRotation(vector) {
    const angle = Math.hypot(...vector);
    const scale = angle < 1e-9 ? 0.5 : Math.sin(angle / 2) / angle;
    return [...vector.map((value) => value * scale), Math.cos(angle / 2)];
}

// v + 2 w (u x v) + 2 u x (u x v), with the quaternion (u, w)
function rotate([x, y, z, w], v) {
    const c = cross([x, y, z], v);
    const d = cross([x, y, z], c);
    return v.map((value, i) => value + 2 * (w * c[i] + d[i]));
}

function cross(a, b) {
    return [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]];
}
