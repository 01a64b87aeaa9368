// While the page's module is not there: a part that does not come, as by a Wi-Fi that loses packets, is said, and the page
// loads itself again; after some times only where one asks for it. No module, so that it runs whatever else does not come.
(() => {
    const WAITS_MS = [1000, 3000, 9000];  // before it loads itself again
    const PATIENCE_MS = 30000;  // for a part of which nothing is heard
    const ANSWER_MS = 9000;  // for an answer of the edge
    const COUNT = "share-loads";  // in sessionStorage: of loads that failed one after another
    const loading = document.getElementById("loading");
    let isOver = false;

    const say = (text) => {
        loading.querySelector("p").textContent = text;
        loading.setAttribute("role", "alert");
    };

    const isServed = async () => {
        try {
            return (await fetch(location.href, { cache: "no-store", signal: AbortSignal.timeout(ANSWER_MS) })).ok;
        } catch {
            return false;
        }
    };

    // Load it once it is there: else the browser's own words would stand here, and nothing would try again. The module may
    // come meanwhile: then a wearer is in the room already.
    const loadAgain = (text, tries, count) => {
        const waitMs = WAITS_MS[Math.min(tries, WAITS_MS.length - 1)];
        say(`${text} Loading again in ${waitMs / 1000} s.`);
        setTimeout(async () => {
            const isThere = loading.isConnected && (await isServed());
            if (!loading.isConnected) return;
            if (!isThere) {
                loadAgain("The edge does not answer, or serves no page.", tries + 1, count);
                return;
            }
            sessionStorage.setItem(COUNT, count);
            location.reload();
        }, waitMs);
    };

    const fail = (text, isToRepeat) => {
        if (isOver || !loading.isConnected) return;  // the module removes it
        isOver = true;
        const count = Number(sessionStorage.getItem(COUNT));
        if (isToRepeat && count < WAITS_MS.length) {
            loadAgain(text, count, count + 1);
            return;
        }
        sessionStorage.setItem(COUNT, 0);
        say(text);
    };
    const lost = () => fail("A part of this page did not come: the network lost it, or the edge is not running.", true);

    addEventListener("error", ({ target, message }) => {
        if (target instanceof HTMLScriptElement) lost();
        else if (message) fail(`This page cannot run here: ${message}`, false);
    }, true);
    addEventListener("load", () => loading.isConnected || sessionStorage.removeItem(COUNT));
    setTimeout(lost, PATIENCE_MS);
})();
