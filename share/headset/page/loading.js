// While the page's module is not there: a part that does not come, as by a Wi-Fi that loses packets, is said, and the page
// loads itself again; after some times only where one asks for it. No module, so that it runs whatever else does not come.
(() => {
    const WAITS_MS = [1000, 3000, 9000];  // before it loads itself again
    const PATIENCE_MS = 30000;  // for a part of which nothing is heard
    const COUNT = "share-loads";  // in sessionStorage: of loads that failed one after another
    const loading = document.getElementById("loading");
    let isOver = false;

    const fail = (text, isToRepeat) => {
        if (isOver || !loading.isConnected) return;  // the module removes it
        isOver = true;
        const count = Number(sessionStorage.getItem(COUNT));
        const waitMs = isToRepeat ? WAITS_MS[count] : undefined;
        sessionStorage.setItem(COUNT, waitMs === undefined ? 0 : count + 1);
        const next = waitMs === undefined ? "" : ` Loading again in ${waitMs / 1000} s.`;
        loading.querySelector("p").textContent = text + next;
        loading.setAttribute("role", "alert");
        if (waitMs !== undefined) setTimeout(() => location.reload(), waitMs);
    };
    const lost = () => fail("A part of this page did not come: the network lost it, or the edge is not running.", true);

    addEventListener("error", ({ target, message }) => {
        if (target instanceof HTMLScriptElement) lost();
        else if (message) fail(`This page cannot run here: ${message}`, false);
    }, true);
    addEventListener("load", () => loading.isConnected || sessionStorage.removeItem(COUNT));
    setTimeout(lost, PATIENCE_MS);
})();
