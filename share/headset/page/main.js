// The page: it joins the parts, and draws frames, flat or in the headset.
import { poseCov } from "./alignment.js";
import { Commands } from "./commands.js";
import { Connection } from "./connection.js";
import { T_xr_map } from "./conventions.js";
import { Hud, stateLines } from "./hud.js";
import { Interaction } from "./interaction.js";
import { Latency } from "./latency.js";
import { fromRows, identity, inverse, multiply, rotate, transformPoint } from "./math.js";
import { Panel } from "./panel.js";
import { Placement } from "./placement.js";
import { Preview } from "./preview.js";
import { Renderer } from "./renderer.js";
import { Room } from "./room.js";
import { LABEL_SHARE, Scene } from "./scene.js";

const MEASURED_MS = 2000;
const HUD_MS = 200;
const MAX_AGE_MS = 10000;  // of a pose; beyond, nothing comes: not a latency
const LABEL_PX = 25;  // on flat screens
const STOP_BUTTON = 5;  // B and Y of xr-standard gamepads

class App {
    wearer = "";
    may = { objects: false, commands: false };
    place = { mapId: null, floorZ: 0, T_map_local: identity() };  // of the present frame
    latency = new Latency();  // pose to frame
    script = new Latency();  // what a frame takes here
    session = null;
    frames = 0;
    #flatHandle = 0;
    #space = null;
    #pointers = new Map();  // by input source
    #shownPointers = [];
    #T_local_viewer = identity();
    #viewProjection = identity();
    #T_view_map = identity();
    #eye = new Float64Array(3);
    #frame = { mapId: null, floorZ: 0, eye: null, labelShare: LABEL_SHARE };

    constructor(canvas) {
        this.canvas = canvas;
        this.room = new Room();
        const scheme = location.protocol === "https:" ? "wss" : "ws";
        this.connection = new Connection(`${scheme}://${location.host}/room`, (message) => this.#onMessage(message));
        this.placement = new Placement((text) => this.commands.tell(text));
        this.interaction = new Interaction(this.room, this.connection, this.place);
        this.commands = new Commands(this);
        this.hud = new Hud(this);
        this.renderer = new Renderer(canvas);
        this.scene = new Scene(this.renderer, this.room);
        this.panel = new Panel(this.renderer, this.commands.buttons);
        this.preview = new Preview(canvas, this.interaction);
        setInterval(() => this.#measure(), MEASURED_MS);
        setInterval(() => this.hud.update(), HUD_MS);
        this.hud.update();
        this.#beginFlat();
        const asked = navigator.xr?.isSessionSupported("immersive-ar") ?? Promise.resolve(false);
        asked.then((canEnter) => this.hud.setCanEnter(canEnter));
    }

    get isInHeadset() {
        return this.session !== null;
    }

    // What is the case, line by line: [text, colour].
    get lines() {
        return stateLines(this);
    }

    // One sigma of where the headset is in the map, mm, and by how much that moves, mm/s; null where it is not known.
    get alignmentMm() {
        return this.isInHeadset ? this.placement.sigmaMm(this.#T_local_viewer) : null;
    }

    get driftMmS() {
        return this.isInHeadset ? this.placement.driftMmS(this.#T_local_viewer, performance.now()) : null;
    }

    // T_local_viewer of the present frame.
    get viewerPose() {
        return this.#T_local_viewer;
    }

    pair(code, name, agent) {
        this.connection.pair(code, name, agent);
    }

    // Where the wearer is and looks in the map: {x, y, aheadX, aheadY}; null where it is not known.
    head() {
        if (this.isInHeadset) {
            if (this.place.mapId === null) return null;
            const T = multiply(identity(), this.place.T_map_local, this.#T_local_viewer);
            return { x: T[12], y: T[13], aheadX: -T[8], aheadY: -T[9] };
        }
        const own = this.room.agents.get(this.room.ownAgent);
        if (own?.mapId !== this.place.mapId || this.place.mapId === null) return null;
        return { x: own.T[12], y: own.T[13], aheadX: own.T[8], aheadY: own.T[9] };
    }

    // ------------------------------------------------------------ messages

    #onMessage(message) {
        const nowMs = performance.now();
        this.room.apply(message, nowMs);
        switch (message.type) {
            case "welcome":
                this.wearer = this.interaction.owner = message.name;
                this.may = message.may;
                this.interaction.may = message.may.objects;
                this.#setMount(message.T_body_viewer, message.mount_timeshift_ms);
                break;
            case "refused":
                this.session?.end();
                break;
            case "poses":
                for (const pose of message.poses) if (pose.agent === this.room.ownAgent) this.#onOwnPose(pose);
                break;
            case "map_changed":
                this.#onJoined(message.old, message.new, fromRows(message.T_new_old));
                break;
            case "receipt":
                if (message.reason) this.commands.tell(message.reason);
                break;
            case "command":
                if (message.is_final) this.commands.tell(`${message.robot ?? "robot"}: ${message.text}`);
        }
        for (const { reason } of this.room.removals.splice(0)) this.commands.tell(reason);
    }

    #setMount(rows, timeshiftMs) {
        this.placement.setMount(rows && fromRows(rows), timeshiftMs);
    }

    #onJoined(oldId, newId, T_new_old) {
        this.placement.joined(oldId, newId, T_new_old);
        if (this.place.mapId !== oldId) return;
        this.place.mapId = newId;
        multiply(this.place.T_map_local, T_new_old, this.place.T_map_local);
        this.interaction.joined(T_new_old);
    }

    #onOwnPose(pose) {
        const timeMs = this.connection.clock.toPage(pose.t_ms);
        if (timeMs === null || pose.map_id === null) return;
        this.placement.addPose({
            timeMs,
            timeSigmaMs: this.connection.clock.sigmaMs,
            cov: poseCov(pose.sigma_m, pose.sigma_rad),
            mapId: pose.map_id,
            T_map_body: Float64Array.from(this.room.agents.get(pose.agent).T),
            velocity: pose.velocity,
            angularVelocity: pose.angular_velocity,
        });
    }

    #measure() {
        const summary = this.latency.take();
        this.script.take();
        if (!this.isInHeadset || summary === null || !this.connection.isConnected) return;
        const { mode } = this.placement;
        this.connection.report({ mode, ...summary, alignment_mm: this.alignmentMm, drift_mm_s: this.driftMmS });
    }

    // ------------------------------------------------------------ flat

    #beginFlat() {
        cancelAnimationFrame(this.#flatHandle);
        this.#flatHandle = requestAnimationFrame(this.#drawFlat);
    }

    #drawFlat = (timeMs) => {
        if (this.isInHeadset) return;
        this.#flatHandle = requestAnimationFrame(this.#drawFlat);
        const beganMs = performance.now();
        const { canvas, preview, renderer, place, room } = this;
        const ratio = Math.min(devicePixelRatio, 2);
        const [width, height] = [canvas.clientWidth, canvas.clientHeight].map((side) => Math.round(side * ratio));
        if (canvas.width !== width || canvas.height !== height) [canvas.width, canvas.height] = [width, height];
        place.mapId = room.likelyMap;
        if (place.mapId === null) return;  // the start page: nothing to draw
        place.floorZ = room.floorHeight(place.mapId);
        if (this.frames % 30 === 0) preview.showAll(this.#positions());
        preview.update(width, height);
        this.interaction.hover(preview.pointers);
        this.scene.update(place.mapId, timeMs, this.connection.clock);
        this.#fillFrame(preview.eye, preview.pointers);
        renderer.beginFrame(null);
        multiply(this.#viewProjection, preview.projection, preview.T_camera_map);
        renderer.beginView(0, 0, width, height, this.#viewProjection);
        this.scene.draw(this.#frame);
        this.#noteFrame(beganMs, timeMs, room.agents.get(room.ownAgent));
    };

    #positions() {
        const { agents, objects } = this.room;
        const here = [...agents.values(), ...objects.values()].filter((one) => one.mapId === this.place.mapId);
        return here.map((one) => [one.T[12], one.T[13], (one.T[14] + this.place.floorZ) / 2]);
    }

    #fillFrame(eye, pointers) {
        const frame = this.#frame;
        frame.mapId = this.place.mapId;
        frame.floorZ = this.place.floorZ;
        frame.eye = eye;
        frame.T_map_camera = this.isInHeadset ? null : this.preview.T_map_camera;
        frame.labelShare = this.isInHeadset ? LABEL_SHARE : this.preview.shareOf(LABEL_PX);
        frame.pointers = pointers;
        frame.hovered = this.interaction.hovered;
        frame.panel = this.isInHeadset ? this.panel : null;
        frame.isFlat = !this.isInHeadset;
        frame.hidesOwn = this.isInHeadset;
    }

    // own: the own device, with the newest pose that the frame knew.
    #noteFrame(beganMs, displayMs, own) {
        this.frames++;
        const nowMs = performance.now();
        this.script.add(nowMs - beganMs);
        if (this.isInHeadset && this.placement.isHeld) return;  // no pose was drawn by
        const poseMs = own?.isPosed ? this.connection.clock.toPage(own.stampMs) : null;
        const ageMs = Math.max(nowMs, displayMs) - poseMs;
        if (poseMs !== null && ageMs < MAX_AGE_MS) this.latency.add(Math.max(ageMs, 0));  // clocks may err by a little
    }

    // ------------------------------------------------------------ in the headset

    async enterHeadset() {
        let session = null;
        try {
            const features = { requiredFeatures: ["local-floor"], optionalFeatures: ["hand-tracking"] };
            session = await navigator.xr.requestSession("immersive-ar", features);
            await this.#begin(session);
        } catch (error) {
            session?.end();
            this.commands.tell(`AR did not begin: ${error.message}`);
        }
    }

    leaveHeadset() {
        this.session?.end();
    }

    async #begin(session) {
        const gl = this.renderer.gl;
        await gl.makeXRCompatible();
        session.updateRenderState({ baseLayer: new XRWebGLLayer(session, gl), depthNear: 0.05, depthFar: 100 });
        this.#space = await session.requestReferenceSpace("local-floor");
        this.#space.addEventListener("reset", () => this.#onReset());
        session.addEventListener("end", () => this.#onEnd(session));
        session.addEventListener("selectstart", ({ inputSource }) => (this.#pointerOf(inputSource).wants = "press"));
        session.addEventListener("selectend", ({ inputSource }) => (this.#pointerOf(inputSource).wants = "release"));
        session.addEventListener("inputsourceschange", ({ removed }) => {
            for (const inputSource of removed) this.#dropPointer(inputSource);
        });
        this.session = session;
        this.interaction.panel = this.panel;
        this.panel.forget();
        this.#onReset();
        session.requestAnimationFrame(this.#drawInHeadset);
    }

    #onReset() {
        this.placement.reset();
        this.panel.forget();
    }

    #onEnd(session) {
        if (this.session !== session) return;
        for (const inputSource of [...this.#pointers.keys()]) this.#dropPointer(inputSource);
        this.session = this.interaction.panel = null;
        this.#beginFlat();
    }

    #drawInHeadset = (timeMs, frame) => {
        const { session, renderer, place, placement, panel } = this;
        if (session === null) return;
        session.requestAnimationFrame(this.#drawInHeadset);
        const beganMs = performance.now();
        const viewer = frame.getViewerPose(this.#space);
        if (!viewer) return;  // the headset has lost itself
        const displayMs = frame.predictedDisplayTime ?? timeMs;
        this.#T_local_viewer.set(viewer.transform.matrix);
        placement.update(displayMs, this.#T_local_viewer);
        this.#setPlace();
        panel.place(this.#T_local_viewer);
        this.#updatePointers(frame, beganMs);
        panel.draw(place.T_map_local, () => this.lines, beganMs);
        this.scene.update(place.mapId, displayMs, this.connection.clock);
        transformPoint(this.#eye, place.T_map_local, this.#T_local_viewer.subarray(12, 15));
        this.#fillFrame(this.#eye, this.#shownPointers);
        const layer = session.renderState.baseLayer;
        renderer.beginFrame(layer.framebuffer);
        for (const view of viewer.views) {
            const { x, y, width, height } = layer.getViewport(view);
            inverse(this.#T_view_map, multiply(this.#T_view_map, place.T_map_local, view.transform.matrix));
            multiply(this.#viewProjection, view.projectionMatrix, this.#T_view_map);
            renderer.beginView(x, y, width, height, this.#viewProjection);
            this.scene.draw(this.#frame);
        }
        this.#noteFrame(beganMs, displayMs, this.room.agents.get(this.room.ownAgent));
    };

    // Without a place in the map the panel is drawn all the same.
    #setPlace() {
        const { place, placement } = this;
        place.mapId = placement.mapId;
        if (place.mapId === null) inverse(place.T_map_local, T_xr_map);
        else place.T_map_local.set(placement.T_map_local);
        const foot = [this.#T_local_viewer[12], 0, this.#T_local_viewer[14]];  // in local-floor, under the wearer
        place.floorZ = transformPoint(foot, place.T_map_local, foot)[2];
    }

    #updatePointers(frame, nowMs) {
        this.#shownPointers.length = 0;
        for (const inputSource of frame.session.inputSources) {
            const pose = frame.getPose(inputSource.targetRaySpace, this.#space);
            const pointer = this.#pointerOf(inputSource);
            this.#stopByButton(inputSource, pointer);
            if (!pose) continue;
            const T = multiply(pointer.T_map_pointer, this.place.T_map_local, pose.transform.matrix);
            rotate(pointer.direction, T, [0, 0, -1]);
            for (let i = 0; i < 3; i++) pointer.origin[i] = T[12 + i];
            if (pointer.wants === "press") this.interaction.press(pointer, nowMs);
            this.interaction.move(pointer, nowMs);
            if (pointer.wants === "release") this.interaction.release(pointer, nowMs);
            pointer.wants = null;
            this.#shownPointers.push(pointer);
        }
        this.interaction.hover(this.#shownPointers);
    }

    #stopByButton({ gamepad }, pointer) {
        const isDown = gamepad?.buttons[STOP_BUTTON]?.pressed ?? false;
        if (isDown && !pointer.isStopDown) this.commands.stop();
        pointer.isStopDown = isDown;
    }

    #pointerOf(inputSource) {
        let pointer = this.#pointers.get(inputSource);
        if (pointer === undefined) {
            const state = { isPressed: false, isStopDown: false, reach: null, wants: null };
            pointer = { origin: [0, 0, 0], direction: [0, 0, -1], T_map_pointer: identity(), ...state };
            this.#pointers.set(inputSource, pointer);
        }
        return pointer;
    }

    #dropPointer(inputSource) {
        const pointer = this.#pointers.get(inputSource);
        if (pointer === undefined) return;
        this.interaction.release(pointer, performance.now());
        this.#pointers.delete(inputSource);
    }
}

export const app = new App(document.getElementById("view"));
document.getElementById("loading").remove();  // so loading.js has nothing more to say
