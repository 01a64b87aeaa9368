// Poses of a SHARE agent for a web page (three.js, Babylon.js, plain WebXR), by WebSocket:
//     share agent realsense --name ann --kind ar --edge tcp://H:P --poses ws://127.0.0.1:5571
// A page from elsewhere than this machine needs --poses-origin https://its.origin.
//
//     import { SharePoses } from "./share-poses.js";
//     const poses = new SharePoses("ws://127.0.0.1:5571");
//     function render() {                       // each animation frame
//         const matrix = poses.matrix();        // of the device in the shared map; null while it is unknown
//         if (matrix) device.matrix.fromArray(matrix);   // three.js; device.matrixAutoUpdate = false
//     }

// examples/conventions.json, "webxr": a test holds these against it. Rows.
const WORLD = [[0, -1, 0], [0, 0, 1], [-1, 0, 0]];
const BODY = [[1, 0, 0], [0, -1, 0], [0, 0, -1]];

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
            if (message.schema === 3) this.message = message;
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

    matrix() {
        const pose = this.message && this.message[this.frame];
        return pose ? toMatrix(pose.position, pose.quaternion) : null;
    }
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

// v + 2 w (u x v) + 2 u x (u x v), with the quaternion (u, w)
function rotate([x, y, z, w], v) {
    const c = cross([x, y, z], v);
    const d = cross([x, y, z], c);
    return v.map((value, i) => value + 2 * (w * c[i] + d[i]));
}

function cross(a, b) {
    return [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]];
}
