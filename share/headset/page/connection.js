// The page's connection to the edge's headset server: pairs once, then comes back by itself with the session's secret.
// What was put or removed and not acknowledged is sent again; a goal is not: nobody would expect a robot to leave late.
import { ServerClock } from "./clock.js";

const SCHEMA = 1;
const FIRST_WAIT_MS = 500;
const LONGEST_WAIT_MS = 5000;
const PING_MS = 1000;
const FIRST_PINGS = 5;  // in quick succession, for the clock
const SEEN_EVERY = 4;  // messages with poses; the server waits once 16 were not acknowledged
const SILENT_MS = 3500;  // without any message the connection counts as lost
const SECRET = "share-session";  // in sessionStorage: a page that is loaded again goes on
const OUTDATED = "share-outdated";  // in sessionStorage: it has loaded itself again, for an edge of another release

export class Connection {
    clock = new ServerClock();
    isPaired = false;
    isConnected = false;
    text = "not paired";
    #url;
    #onMessage;
    #socket = null;
    #waitMs = FIRST_WAIT_MS;
    #timers = [];
    #hello = null;
    #pending = new Map();  // by what it is about: the newest that is not acknowledged
    #number = Date.now();  // of requests and commands: rises, also after the page was loaded again
    #pings = 0;
    #heardMs = 0;
    #others = new BroadcastChannel("share-pages");  // of this browser; a tab that is doubled has the same session

    constructor(url, onMessage) {
        this.#url = url;
        this.#onMessage = onMessage;
        this.#others.onmessage = ({ data }) => data === this.#hello?.session && this.#onTakenOver();
        const session = sessionStorage.getItem(SECRET);
        if (session === null) return;
        this.#hello = { session };
        this.isPaired = true;
        this.#connect();
    }

    // Where an answer is "refused", the pairing form comes again.
    pair(code, name, agent) {
        this.#hello = { code, name, agent };
        this.#connect();
    }

    put(id, kind, mapId, position, quaternion) {
        return this.#request(id, { type: "put", id, kind, map_id: mapId, position, quaternion });
    }

    remove(id) {
        return this.#request(id, { type: "remove", id });
    }

    // Whether what was put or removed last under this id waits for its receipt.
    isPending(id) {
        return this.#pending.has(id);
    }

    // The number of the command; null where no edge would hear it now.
    goto(robot, mapId, x, y, yaw = null) {
        if (!this.isConnected) return null;
        this.#send({ type: "goto", command: ++this.#number, robot, map_id: mapId, x, y, yaw });
        return this.#number;
    }

    // Stopping is sent again until a state of it comes.
    cancel(robot) {
        const message = { type: "cancel", command: ++this.#number, robot };
        this.#pending.set(`cancel ${robot ?? ""}`, message);
        this.#send(message);
        return this.#number;
    }

    wantPoints(mapId) {
        this.#send({ type: "points", map_id: mapId });
    }

    report(measured) {
        this.#send({ type: "measured", ...measured });
    }

    #request(key, message) {
        message.request = ++this.#number;
        this.#pending.set(key, message);
        this.#send(message);
        return message.request;
    }

    #send(message) {
        if (this.isConnected) this.#socket.send(JSON.stringify(message));
    }

    #connect() {
        this.#leave();
        this.text = this.isPaired ? "connecting again" : "connecting";
        const socket = (this.#socket = new WebSocket(this.#url));
        this.#heardMs = performance.now();
        socket.onopen = () => socket.send(JSON.stringify({ type: "hello", schema: SCHEMA, ...this.#hello }));
        socket.onmessage = (event) => this.#onText(event.data);
        socket.onclose = () => this.#onClosed();
        this.#timers.push(setInterval(() => this.#watch(), PING_MS));
    }

    // Have done with the present socket, whatever it still says.
    #leave() {
        this.#timers.forEach(clearTimeout);  // of intervals too
        this.#timers = [];
        this.isConnected = false;
        if (this.#socket === null) return;
        this.#socket.onopen = this.#socket.onmessage = this.#socket.onclose = null;
        this.#socket.close();
        this.#socket = null;
    }

    #onClosed() {
        this.#leave();
        if (!this.isPaired) {
            this.text = "no answer from the server: is the edge running?";
            this.#hello = null;
            this.#onMessage({ type: "refused", reason: this.text });
            return;
        }
        this.text = `connection lost, trying again in ${(this.#waitMs / 1000).toFixed(1)} s`;
        this.#timers.push(setTimeout(() => this.#connect(), this.#waitMs));
        this.#waitMs = Math.min(2 * this.#waitMs, LONGEST_WAIT_MS);
    }

    #watch() {
        if (performance.now() - this.#heardMs > SILENT_MS) this.#onClosed();
        else if (this.isConnected) this.#ping();
    }

    #ping() {
        this.#send({ type: "ping", n: ++this.#pings, sent_ms: performance.now() });
    }

    #onText(data) {
        this.#heardMs = performance.now();
        const message = JSON.parse(data);
        switch (message.type) {
            case "pong":
                this.clock.add(message.sent_ms, message.t_ms, this.#heardMs);
                return;
            case "welcome":
                this.#onWelcome(message);
                break;
            case "refused":
                if (this.isPaired && !message.is_over) {
                    if (message.is_outdated && this.#renew()) return;
                    this.#tryLater(message.reason);
                    return;
                }
                this.#onRefused(message);
                break;
            case "receipt":
                this.#forget(({ request }) => request === message.request);
                break;
            case "command":
                this.#forget(({ type, command }) => type === "cancel" && command === message.command);
        }
        this.#onMessage(message);
        if (message.type === "poses" && message.n % SEEN_EVERY === 0) this.#send({ type: "seen", n: message.n });
    }

    #forget(isAnswered) {
        for (const [key, message] of this.#pending) if (isAnswered(message)) this.#pending.delete(key);
    }

    #onWelcome(welcome) {
        sessionStorage.setItem(SECRET, welcome.session);
        sessionStorage.removeItem(OUTDATED);
        this.#hello = { session: welcome.session };
        this.isPaired = this.isConnected = true;
        this.#waitMs = FIRST_WAIT_MS;
        this.text = "connected";
        this.#others.postMessage(welcome.session);
        for (let k = 0; k < FIRST_PINGS; k++) this.#timers.push(setTimeout(() => this.#ping(), 60 * k));
        for (const message of this.#pending.values()) this.#send(message);
    }

    // Take the page of the edge as it is now, which goes on with the session; once, else it would do so for ever.
    #renew() {
        if (sessionStorage.getItem(OUTDATED) !== null) return false;
        this.#leave();
        sessionStorage.setItem(OUTDATED, "1");
        location.reload();
        return true;
    }

    // The session stays: what hinders it may pass.
    #tryLater(reason) {
        this.#leave();
        this.text = reason;
        this.#timers.push(setTimeout(() => this.#connect(), LONGEST_WAIT_MS));
    }

    // Nothing more is tried: the secret holds no longer, or another page has it.
    #onRefused({ reason }) {
        this.#leave();
        sessionStorage.removeItem(SECRET);
        this.#hello = null;
        this.isPaired = false;
        this.text = reason;
    }

    #onTakenOver() {
        const message = { type: "refused", reason: "another page of this browser goes on with the session" };
        this.#onRefused(message);
        this.#onMessage(message);
    }
}
