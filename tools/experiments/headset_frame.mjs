// What a frame of the headset page takes of its own: its modules before a WebGL that does nothing. Prints JSON: calls of
// WebGL a frame, and the CPU time of a frame, us, in batches of 2,000. Node.js 20:
//
//     node --experimental-default-type=module tools/experiments/headset_frame.mjs
//
// Three agents, a marker, three cubes, two rays and a panel in two eyes, at 72 frames a second of its own time; poses of all
// agents 36 times a second, and the alignment. Left out: the text of messages, the drawing of the panel and of labels.

const PAGE = new URL("../../share/headset/page/", import.meta.url);
const FRAMES_HZ = 72;
const [WARM, BATCHES, BATCH] = [20000, 20, 2000];

const nothing = () => {};
const context = new Proxy({}, { get: (_, name) => (name === "measureText" ? () => ({ width: 100 }) : nothing), set: () => true });
globalThis.document = { createElement: () => ({ getContext: () => context }), getElementById: () => null };

let calls = null;
const gl = {};
for (const name of [
    "attachShader", "bindBuffer", "bindFramebuffer", "bindTexture", "bindVertexArray", "blendFunc", "bufferData", "clear",
    "clearColor", "compileShader", "createBuffer", "createProgram", "createShader", "createTexture", "createVertexArray",
    "deleteTexture", "depthMask", "disable", "drawArrays", "drawArraysInstanced", "enable", "enableVertexAttribArray",
    "generateMipmap", "getProgramParameter", "getUniformLocation", "linkProgram", "pixelStorei", "shaderSource",
    "texImage2D", "texParameteri", "uniform1f", "uniform2fv", "uniform4f", "uniformMatrix4fv", "useProgram",
    "vertexAttribDivisor", "vertexAttribPointer", "viewport",
]) {
    const answers = /^(create|get)/.test(name);
    gl[name] = () => {
        if (calls !== null) calls[name] = (calls[name] ?? 0) + 1;
        return answers ? {} : undefined;
    };
}

const load = (name) => import(new URL(name, PAGE));
const { Renderer } = await load("renderer.js");
const { Scene } = await load("scene.js");
const { Room } = await load("room.js");
const { Placement } = await load("placement.js");
const { poseCov } = await load("alignment.js");
const { identity, inverse, multiply } = await load("math.js");

const [room, renderer, placement] = [new Room(), new Renderer({ getContext: () => gl }), new Placement()];
const scene = new Scene(renderer, room);
const clock = { toPage: (ms) => ms };
const [T_local_viewer, view] = [identity(), identity()];
const pointer = { T_map_pointer: identity(), reach: 1.5, isPressed: true };
const drawn = {
    mapId: "m", floorZ: 0, eye: new Float64Array(3), T_map_camera: null, labelShare: 0.027, pointers: [pointer, pointer],
    hovered: null, panel: { texture: {}, model: new Float32Array(16) }, isFlat: false, hidesOwn: true,
};

room.apply({ type: "welcome", agent: "ann", agents: [] }, 0);
const objects = ["marker", "cube", "cube", "cube"].map((kind, id) => (
    { id, kind, owner: "ann", map_id: "m", position: [id, 1, 0], quaternion: [0, 0, 0, 1] }
));
room.apply({ type: "objects", objects }, 0);

function hear(ms) {
    const place = { state: "OK", map_id: "m", t_ms: ms - 20, position: [0.3 * Math.sin(ms / 1000), 0, 1], quaternion: [0, 0, 0, 1] };
    const motion = { velocity: [0.1, 0, 0], angular_velocity: [0, 0.2, 0], sigma_m: 0.006, sigma_rad: 0.002 };
    const named = (agent, kind) => ({ agent, kind, ...place, ...motion });
    room.apply({ type: "poses", poses: [named("ann", "ar"), named("ben", "ar"), named("bot", "robot")] }, ms);
    const T_map_body = Float64Array.from(room.agents.get("ann").T);
    const { velocity, angular_velocity: angularVelocity } = motion;
    placement.addPose({ timeMs: ms - 20, cov: poseCov(0.006, 0.002), mapId: "m", T_map_body, velocity, angularVelocity });
}

let count = 0;
function frame() {
    const ms = (count * 1000) / FRAMES_HZ;
    if (count++ % 2 === 0) hear(ms);
    T_local_viewer[12] = 0.3 * Math.sin(ms / 1000);
    placement.update(ms, T_local_viewer);
    scene.update("m", ms, clock);
    renderer.beginFrame(null);
    for (let eye = 0; eye < 2; eye++) {
        inverse(view, multiply(view, placement.T_map_local, T_local_viewer));
        renderer.beginView(0, 0, 100, 100, view);
        scene.draw(drawn);
    }
}

for (let k = 0; k < WARM; k++) frame();
calls = {};
frame();
const one = calls;
calls = null;
const cpuUs = Array.from({ length: BATCHES }, () => {
    const before = process.cpuUsage();
    for (let k = 0; k < BATCH; k++) frame();
    const { user, system } = process.cpuUsage(before);
    return (user + system) / BATCH;
}).sort((a, b) => a - b);
const all = Object.values(one).reduce((sum, value) => sum + value, 0);
const round = (value) => Math.round(10 * value) / 10;
console.log(JSON.stringify({ webgl_calls: all, of_these: one, cpu_us: { median: round(cpuUs[BATCHES / 2]), least: round(cpuUs[0]) } }, null, 1));
