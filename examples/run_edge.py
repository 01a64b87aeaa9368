"""Run an edge in your own program, and two agents that share its map.

python examples/run_edge.py room1/ann room1/bob
"""

import sys

from share import Agent, Edge


def main() -> None:
    if len(sys.argv) < 2:
        sys.exit(__doc__)
    with Edge("tcp://127.0.0.1:0") as edge:  # port 0: a free one
        agents = {path: Agent(path, path.rpartition("/")[2], edge.endpoint) for path in sys.argv[1:]}
        for agent in agents.values():
            agent.start()
        for path, agent in agents.items():
            agent.wait()
            pose = agent.pose  # its last
            where = "lost" if pose is None else f"{pose.position.round(2)} m in odom, map {pose.map_id}"
            print(f"{path}: {where}", flush=True)
        print(f"keyframes in maps: {dict(edge.report().get('maps', {}))}")


if __name__ == "__main__":  # the edge's mapper is a process that imports this file
    main()
