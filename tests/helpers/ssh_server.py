"""A real sshd on this machine, at a port and with keys of its own."""

from __future__ import annotations

import getpass
import os
import shutil
import socket
import subprocess
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

SSHD = shutil.which("sshd", path=f"{os.environ['PATH']}:/usr/sbin")
SSH = shutil.which("ssh")  # the whole path: a test may have another one in front
HOST = f"{getpass.getuser()}@127.0.0.1"

_SETTINGS = """
Port {port}
ListenAddress 127.0.0.1
HostKey {folder}/host
AuthorizedKeysFile {folder}/client.pub
PermitRootLogin yes
PasswordAuthentication no
StrictModes no
UsePAM no
PidFile none
SetEnv PATH={path}
"""


@contextmanager
def ssh_server(folder: Path, path: str) -> Iterator[str]:
    """The ssh command that gets in. path: $PATH of those who do. Skips the test where there is no sshd."""
    if SSHD is None or SSH is None:
        pytest.skip("needs sshd and ssh (apt install openssh-server)")
    if os.geteuid() == 0:
        Path("/run/sshd").mkdir(exist_ok=True)  # it wants this folder, as root
    folder.mkdir()
    for name in ("host", "client"):
        subprocess.run(["ssh-keygen", "-q", "-t", "ed25519", "-N", "", "-f", folder / name], check=True)
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port = probe.getsockname()[1]
    (folder / "settings").write_text(_SETTINGS.format(port=port, folder=folder, path=path))
    with subprocess.Popen([SSHD, "-D", "-e", "-f", folder / "settings"], stderr=subprocess.DEVNULL) as server:
        try:
            _wait(port, server)
            yield f"{SSH} -p {port} -i {folder}/client -o UserKnownHostsFile={folder}/known -o " + (
                "StrictHostKeyChecking=accept-new -o IdentitiesOnly=yes -o LogLevel=ERROR -F none"
            )
        finally:
            server.terminate()


def _wait(port: int, server: subprocess.Popen[bytes]) -> None:
    deadline = time.monotonic() + 20
    while time.monotonic() < deadline and server.poll() is None:
        with socket.socket() as probe:
            if probe.connect_ex(("127.0.0.1", port)) == 0:
                return
        time.sleep(0.05)
    pytest.skip("sshd does not start here")
