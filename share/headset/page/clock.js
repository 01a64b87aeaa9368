// The server's monotonic clock from pings: of the newest, the one with the least round trip counts.

const KEPT = 20;  // at one a second, clocks drift apart by 1 ms at most meanwhile

export class ServerClock {
    #samples = [];
    #best = null;

    add(sentMs, serverMs, nowMs) {
        this.#samples.push({ roundTripMs: nowMs - sentMs, offsetMs: serverMs - (sentMs + nowMs) / 2 });
        if (this.#samples.length > KEPT) this.#samples.shift();
        this.#best = this.#samples.reduce((best, one) => (one.roundTripMs < best.roundTripMs ? one : best));
    }

    // After a reconnection it may be another server.
    forget() {
        this.#samples = [];
        this.#best = null;
    }

    get isKnown() {
        return this.#best !== null;
    }

    // The error is at most half of it.
    get roundTripMs() {
        return this.#best?.roundTripMs ?? null;
    }

    // On the page's clock (performance.now()); null before the first answer.
    toPage(serverMs) {
        return this.#best === null ? null : serverMs - this.#best.offsetMs;
    }
}
