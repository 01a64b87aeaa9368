// The server's monotonic clock from pings: of the newest, the one with the least round trip counts. Each bounds the
// offset by half its round trip; one that contradicts the best is of another clock (another server, one whose machine
// has started anew, or this page slept), and those before it are dropped. So a reconnection keeps what is known.

const KEPT = 20;  // at one a second, clocks drift apart by 1 ms at most meanwhile
const DRIFT_MS = 5;  // by which samples may contradict each other

export class ServerClock {
    #samples = [];
    #best = null;

    add(sentMs, serverMs, nowMs) {
        const sample = { roundTripMs: nowMs - sentMs, offsetMs: serverMs - (sentMs + nowMs) / 2 };
        if (this.#best !== null && isContradicted(sample, this.#best)) this.#samples = [];
        this.#samples.push(sample);
        if (this.#samples.length > KEPT) this.#samples.shift();
        this.#best = this.#samples.reduce((best, one) => (one.roundTripMs < best.roundTripMs ? one : best));
    }

    get isKnown() {
        return this.#best !== null;
    }

    // The error is at most half of it.
    get roundTripMs() {
        return this.#best?.roundTripMs ?? null;
    }

    // Standard deviation of the error, which is anywhere within its bounds; 0 before the first answer.
    get sigmaMs() {
        return (this.roundTripMs ?? 0) / 2 / Math.sqrt(3);
    }

    // On the page's clock (performance.now()); null before the first answer.
    toPage(serverMs) {
        return this.#best === null ? null : serverMs - this.#best.offsetMs;
    }
}

function isContradicted(one, other) {
    return Math.abs(one.offsetMs - other.offsetMs) > (one.roundTripMs + other.roundTripMs) / 2 + DRIFT_MS;
}
