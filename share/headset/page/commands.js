// What the buttons do: those of the panel in the headset and those under the preview are the same.

const KEEP_OFF_M = 0.8;  // that a robot stops before who calls it

export class Commands {
    robot = null;  // that is sent; null: the only one
    notice = { text: "", sinceMs: -Infinity };

    constructor(app) {
        this.app = app;
        const { interaction, room } = app;
        const arm = (what) => ({
            run: () => interaction.arm(what),
            isActive: () => interaction.armed === what,
            isEnabled: () => app.may.objects && app.place.mapId !== null,
        });
        const sends = (run) => ({ run, isEnabled: () => app.may.commands && app.place.mapId !== null });
        const inHeadset = () => app.isInHeadset;
        this.buttons = [
            button("cube", () => "Cube", arm("cube")),
            button("marker", () => "Marker", arm("marker")),
            button("remove", () => "Remove", arm("remove")),
            button("points", () => "Map points", {
                run: () => this.#togglePoints(),
                isActive: () => room.points.mapId !== null,
                isEnabled: () => app.place.mapId !== null,
            }),
            button("here", () => "Come here", sends(() => this.#comeHere())),
            button("there", () => "Go there", sends(() => this.#goThere())),
            button("stop", () => "Stop", { run: () => this.stop(), isStop: true }),
            button("robot", () => `Robot: ${this.robot ?? "any"}`, {
                run: () => this.#nextRobot(),
                isShown: () => this.#robots().length > 1,
            }),
            button("mode", () => `Mode: ${app.placement.mode}`, {
                run: () => app.placement.setMode(app.placement.mode === "align" ? "follow" : "align"),
                isShown: inHeadset,
            }),
            button("leave", () => "Leave", { run: () => app.leaveHeadset(), isShown: inHeadset }),
        ];
    }

    tell(text) {
        this.notice = { text, sinceMs: performance.now() };
    }

    // For everybody and always: without rights too.
    stop() {
        this.app.connection.cancel(this.robot);
        this.tell(this.app.connection.isConnected ? "stop sent" : "stop will be sent once connected: go to the robot");
    }

    #comeHere() {
        const head = this.app.head();
        if (head === null) {
            this.tell("where you are in the map is not known");
            return;
        }
        const { x, y, aheadX, aheadY } = head;
        const isMeant = (one) => one.kind === "robot" && one.mapId === this.app.place.mapId;
        const robots = [...this.app.room.agents.values()].filter(isMeant);
        const robot = robots.find((one) => (this.robot ?? one.name) === one.name);
        const [dx, dy] = robot ? [robot.T[12] - x, robot.T[13] - y] : [aheadX, aheadY];
        const distance = Math.hypot(dx, dy) || 1;
        if (robot && distance <= KEEP_OFF_M) {
            this.tell("it is here");
            return;
        }
        this.#send(x + (dx / distance) * KEEP_OFF_M, y + (dy / distance) * KEEP_OFF_M, "called");
    }

    // To the wearer's own marker, else to the newest that there is.
    #goThere() {
        const { room, place, wearer } = this.app;
        const markers = [...room.objects.values()].filter((one) => one.kind === "marker" && one.mapId === place.mapId);
        const target = markers.filter((one) => one.owner === wearer).at(-1) ?? markers.at(-1);
        if (target === undefined) this.tell("place a marker first");
        else this.#send(target.T[12], target.T[13], `sent to the marker of ${target.owner}`);
    }

    #send(x, y, what) {
        const command = this.app.connection.goto(this.robot, this.app.place.mapId, x, y);
        this.tell(command === null ? "not connected: nothing is sent" : what);
    }

    #togglePoints() {
        const { room, connection, place } = this.app;
        const isShown = room.points.mapId !== null;
        room.clearPoints();
        if (!isShown) connection.wantPoints(place.mapId);
    }

    #robots() {
        return [...this.app.room.robots.keys()];
    }

    #nextRobot() {
        const names = this.#robots();
        this.robot = names[(names.indexOf(this.robot) + 1) % names.length];
    }
}

function button(name, text, more) {
    const usual = { isShown: () => true, isEnabled: () => true, isActive: () => false, isStop: false };
    return { name, text, ...usual, ...more };
}
