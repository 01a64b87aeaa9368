"""Place a cube in the shared room, move it, and see what others place; send a robot to it.

python examples/shared_objects.py tcp://127.0.0.1:5555 ann [ROBOT]

The edge: `share edge --allow objects --allow commands`, or keys with `--objects --commands`.
"""

import sys

from share import Room, ShareError


def main() -> None:
    if len(sys.argv) < 3:
        sys.exit(__doc__)
    edge, name, *robot = sys.argv[1:]
    with Room(edge, name) as room:
        cube = room.put("cube", (1.0, 2.0, 0.5))  # m, in the map of the agent of this name, or the only one
        for step in range(10):
            room.put("cube", (1.0 + 0.1 * step, 2.0, 0.5), object_id=cube)
        for object_id, seen in room.objects.items():
            place = seen.T_map_object[:3, 3].round(2)
            print(f"{object_id}: {seen.kind} of {seen.owner} at {place} m in {seen.map_id}")
        if robot:
            goal = room.goto(1.9, 2.0, robot=robot[0])
            print("there" if goal.wait(60) else goal.text)
        room.remove(cube)


if __name__ == "__main__":
    try:
        main()
    except ShareError as error:
        sys.exit(str(error))
