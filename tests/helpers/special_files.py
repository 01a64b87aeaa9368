"""What has a file's name and is no regular file."""

import os
import socket
from pathlib import Path


def special(path: Path, kind: str) -> None:
    match kind:
        case "pipe":
            os.mkfifo(path)
        case "device":
            path.symlink_to("/dev/zero")
        case "folder":
            path.mkdir()
        case "socket":
            server = socket.socket(socket.AF_UNIX)
            here = os.getcwd()
            os.chdir(path.parent)  # a socket's path is short
            server.bind(path.name)
            os.chdir(here)
            server.close()


KINDS = ("pipe", "device", "folder", "socket")
