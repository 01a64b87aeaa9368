"""CurveZMQ key pairs, and the edge's list of authorized keys, as text files.

A folder holds one machine's key pair, `NAME.public` and `NAME.secret`, and at an edge the list `authorized`.
Each file consists of lines `share-public-key NAME KEY` (`share-secret-key` for the secret). In the list the
names of the agents that may run on that machine can follow; without any, only the agent NAME may; then what
it may do as a client, +commands and +objects. KEY is a 32-byte Curve25519 key in Z85 (RFC 26 CurveZMQ, RFC 32
Z85): 40 characters, none of them a quote.
"""

from __future__ import annotations

import os
import re
import socket
import stat
import struct
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import NamedTuple

from share.errors import UsageError
from share.files.locks import folder_locked
from share.files.reading import MAX_KEYS_BYTES, read_text
from share.files.writing import atomic_write, write_private, xdg_folder
from share.wire.room_messages import Permission

_NAME = r"[A-Za-z0-9_][A-Za-z0-9_.-]{0,63}"
_Z85 = r"[0-9a-zA-Z.:+=^!/*?&<>()\[\]{}@%$#-]{40}"
_LIST_FILE = "authorized"
_MAY = "|".join(Permission)
_LINE = re.compile(rf"share-(public|secret)-key ({_NAME}) ({_Z85})((?: {_NAME})*)((?: \+(?:{_MAY}))*)")


@dataclass(frozen=True)
class KeyPair:
    """The key pair of one machine, in Z85."""

    name: str
    public: str
    secret: str = field(repr=False)


@dataclass(frozen=True)
class AgentKeys:
    """Keys of an agent: its own pair and the public key of its edge. is_lent: the edge made the pair, for a
    name of its list."""

    own: KeyPair
    edge: str
    is_lent: bool = False


@dataclass(frozen=True)
class EdgeKeys:
    """Keys of an edge: its own pair and the list of authorized keys."""

    own: KeyPair
    allowed: AllowList


class AllowList:
    """The authorized keys, always as the file says now; none without a file. Safe from several threads.

    public_key_of: of each name in the list, the key that is lent for its clients (`share.net.lent_keys`)."""

    def __init__(self, path: Path, public_key_of: Callable[[str], str] | None = None) -> None:
        self.path, self.public_key_of = path, public_key_of
        self._cached: tuple[tuple[int, ...], dict[str, Grant]] = (), {}
        self._lent: tuple[dict[str, Grant], dict[str, Grant]] = {}, {}  # of which grants, by lent key
        self._was_lent: dict[str, str] = {}  # names that the list has had, by lent key

    def names_by_key(self) -> dict[str, str]:
        """Return machine names by public key. Raises UsageError if the file is unreadable or malformed."""
        return {key: grant.name for key, grant in self.grants().items()}

    def agents_for(self, public: str) -> frozenset[str]:
        """Return the names of the agents that this key may act for; none while the file is unreadable."""
        return frozenset(self._grant(public).agents)

    def permissions_of(self, public: str) -> frozenset[Permission]:
        """Return what this key may do as a client; nothing while the file is unreadable."""
        return self._grant(public).permissions

    def rights(self) -> dict[str, frozenset[Permission]]:
        """Return the names of all agents, each with what its clients may do by one key or another. Raises
        UsageError as `grants`."""
        rights: dict[str, frozenset[Permission]] = {}
        for grant in self.grants().values():
            for name in grant.agents:
                rights[name] = rights.get(name, frozenset()) | grant.permissions
        return rights

    def _grant(self, public: str) -> Grant:
        """Return what a key is granted, also a lent one; nothing while the file is unreadable."""
        try:
            grants = self.grants()
            if public not in grants and self.public_key_of is not None:
                if self._lent[0] is not grants:  # the file is another
                    rights, key_of = self.rights().items(), self.public_key_of
                    self._lent = grants, {key_of(name): Grant(name, (name,), may) for name, may in rights}
                    self._was_lent |= {key: grant.name for key, grant in self._lent[1].items()}
                grants = self._lent[1]
        except UsageError:
            grants = {}
        return grants.get(public, Grant("", ()))

    def grants(self) -> dict[str, Grant]:
        """Return all grants by public key. Raises UsageError if the file is unreadable or malformed."""
        try:
            status = self.path.stat()
        except FileNotFoundError:
            return {}
        except OSError as error:
            raise UsageError(f"{self.path}: cannot be read: {error.strerror}") from None
        _check_not_world_writable(self.path, status)
        state = (status.st_mtime_ns, status.st_ino, status.st_size)
        if state != self._cached[0]:
            lines = _read_lines(self.path)
            self._cached = state, {line.key: line.grant for line in lines if line.grant is not None}
        return self._cached[1]

    def is_allowed(self, public: str) -> bool:
        """Return whether that key may connect; False while the file is unreadable."""
        return bool(self.agents_for(public))

    def refusal(self, public: str, address: str) -> str:
        """Return the refusal of a key that may not connect, and its remedy."""
        if (name := self._was_lent.get(public)) is not None:  # nobody has that key in a file
            return f"a client of '{name}' ({address}): the list has no agent of that name any more"
        what = f"the key '{public}' ({address}) is not authorized"
        return f"{what}; to authorize it: share keys authorize NAME '{public}'"

    def trouble(self) -> str | None:
        """Return why no key may connect; None if the file is readable."""
        try:
            self.grants()
        except UsageError as error:
            return str(error)
        return None


class Grant(NamedTuple):
    """An entry of the list: the machine's name, the agents that its key may act for, and its rights as a
    client."""

    name: str
    agents: tuple[str, ...]
    permissions: frozenset[Permission] = frozenset()


class _ListLine(NamedTuple):
    """A line of the list, with its newline. grant: None for a comment."""

    text: str
    key: str = ""
    grant: Grant | None = None


def default_folder() -> Path:
    """Return $XDG_CONFIG_HOME/share/keys, or ~/.config/share/keys."""
    return xdg_folder("XDG_CONFIG_HOME", ".config") / "share" / "keys"


def generate_pair(folder: Path, name: str | None = None) -> KeyPair:
    """Make a pair in `folder`, named after this machine unless `name` is given. Raises UsageError, also if a
    pair exists: it is never replaced."""
    import zmq

    name = _checked_name(
        name or re.sub(r"[^A-Za-z0-9_-]", "-", socket.gethostname()).strip("-")[:64] or "share"
    )
    _make_folder(folder)
    with folder_locked(folder):
        if old := _secret_files(folder):
            raise UsageError(f"{old[0]}: there is a key pair already; give another folder with --keys")
        public, secret = b"-", b""
        while not public[:1].isalnum():  # a command line could take the key for an option otherwise
            public, secret = zmq.curve_keypair()
        pair = KeyPair(name, public.decode(), secret.decode())
        write_private(folder / f"{name}.secret", f"share-secret-key {name} {pair.secret}\n")
        atomic_write(folder / f"{name}.public", _format_line(name, pair.public))
    return pair


def has_pair(folder: Path) -> bool:
    """Return whether `folder` holds a pair. Raises UsageError if it is unreadable."""
    return bool(_secret_files(folder))


def load_pair(folder: Path) -> KeyPair:
    """Read the pair in `folder`. Raises UsageError if there is not exactly one, or others can read it."""
    import zmq

    secrets = _secret_files(folder)
    if not secrets:
        where = "" if folder == default_folder() else f" --keys {folder}"
        raise UsageError(f"{folder}: has no key pair; make one with `share keys generate{where}`")
    if len(secrets) > 1:
        raise UsageError(f"{folder}: has {len(secrets)} key pairs; keep one in each folder")
    path = secrets[0]
    _check_not_world_writable(folder, folder.stat())
    if path.stat().st_mode & 0o077:
        raise UsageError(f"{path}: others can read this secret; `chmod 600 {path}`, or make a new pair")
    match = _LINE.fullmatch(_read_text(path).strip())
    if not match or match[1] != "secret" or not _is_key(match[3]) or match[4] or match[5]:
        raise UsageError(
            f"{path}: is not a SHARE secret key; move it away and make a new pair with `share keys generate`"
        )
    return KeyPair(match[2], zmq.curve_public(match[3].encode()).decode(), match[3])


def public_key(key_or_path: str) -> str:
    """Return the public key in the file `key_or_path`, or `key_or_path` itself if it is a key and no path.
    Raises UsageError."""
    if os.path.isfile(key_or_path):  # first: 40 characters of a path can be a key's too
        return _parse_line(_read_text(Path(key_or_path)), key_or_path)[0]
    if key_or_path.startswith("share-"):
        return _parse_line(key_or_path, "the given key")[0]
    if not re.fullmatch(_Z85, key_or_path) or not _is_key(key_or_path):
        raise UsageError(
            f"'{key_or_path:.60}': neither a file nor a public key (40 characters, in single quotes)"
        )
    folder = os.path.dirname(key_or_path)
    if key_or_path.endswith(".public") or (len(folder) > 1 and os.path.isdir(folder)):  # by chance: never
        raise UsageError(f"'{key_or_path}': no such file")
    return key_or_path


def allow_list(folder: Path) -> AllowList:
    return AllowList(folder / _LIST_FILE)


def authorize(
    folder: Path,
    name: str,
    public: str,
    agents: Sequence[str] = (),
    permissions: Mapping[Permission, bool | None] | None = None,
) -> None:
    """Authorize the machine `name` to act for `agents` (default: those before, or the agent `name`).

    permissions: to give (True) or to take back (False); others stay as they are. Raises UsageError if the
    name or the key is taken, or the list is damaged.
    """
    name, agents = _checked_name(name), [_checked_name(agent) for agent in agents]
    _make_folder(folder)
    with folder_locked(folder):  # one of two writers could undo the other's revocation
        grants = allow_list(folder).grants()
        names = {key: grant.name for key, grant in grants.items()}
        old = grants.get(public, Grant(name, ()))
        line = _format_line(name, public, agents or old.agents, _changed(old.permissions, permissions or {}))
        if names.get(public, name) != name:
            raise UsageError(f"'{name}': this key is authorized already, as '{names[public]}'")
        if name in names.values() and public not in names:
            raise UsageError(f"'{name}' has another key; remove it first with `share keys revoke {name}`")
        lines = _read_lines(folder / _LIST_FILE)
        if public not in names:
            _write_list(folder, [*lines, _ListLine(line)])
        else:
            _write_list(folder, [one._replace(text=line) if one.key == public else one for one in lines])


def revoke(folder: Path, name: str) -> None:
    """Remove all keys of the machine `name`. Raises UsageError if there is none, or the list is damaged."""
    if not (folder / _LIST_FILE).exists():
        raise UsageError(f"'{name}' is not authorized; the list is empty")
    with folder_locked(folder):  # one of two writers could undo the other's revocation
        lines = _read_lines(folder / _LIST_FILE)
        keys = {line.key for line in lines if line.grant is not None and line.grant.name == name}
        if not keys:
            others = ", ".join(dict.fromkeys(line.grant.name for line in lines if line.grant is not None))
            names = f"authorized are: {others}" if others else "the list is empty"
            raise UsageError(f"'{name}' is not authorized; {names}")
        _write_list(folder, [line for line in lines if line.key not in keys])  # also under other names


def agent_keys(folder: Path | None, edge: str) -> AgentKeys:
    """Read an agent's keys. folder: with its pair, None for the default; edge: see `public_key`. Raises
    UsageError."""
    return AgentKeys(load_pair(folder or default_folder()), public_key(edge))


def edge_keys(folder: Path | None) -> EdgeKeys:
    """Read an edge's keys in `folder`, None for the default. Raises UsageError, also for a damaged list."""
    folder = folder or default_folder()
    keys = EdgeKeys(load_pair(folder), allow_list(folder))
    keys.allowed.names_by_key()
    return keys


# ---------------------------------------------------------------- files


def edge_keys_for(folder: Path | None, is_local: bool) -> EdgeKeys | None:
    """Return the keys in `folder`, or those in the default folder if the edge is on a network (not
    `is_local`); None if there are none. Raises UsageError."""
    if folder is None and (is_local or not has_pair(default_folder())):
        return None
    return edge_keys(folder)


def allowed_without_keys(names: Collection[str], has_keys: bool) -> frozenset[Permission]:
    """Return what every client may do, by name. Raises UsageError for an unknown name, or with keys."""
    if names and has_keys:
        raise UsageError(
            "--allow: with keys the list says who may; share keys authorize … --commands --objects"
        )
    if unknown := [one for one in names if one not in set(Permission)]:
        raise UsageError(f"--allow {unknown[0]!r:.40}: known are {', '.join(Permission)}")
    return frozenset(map(Permission, names))


def _parse_line(line: str, where: str) -> tuple[str, Grant]:
    """Return the key of a line and what it grants. Raises UsageError."""
    match = _LINE.fullmatch(line.strip())
    if match and match[1] == "secret":
        raise UsageError(f"{where}: is a secret key, which must stay on its machine; give the public key")
    if not match or not _is_key(match[3]):
        raise UsageError(f"{where}: is not `share-public-key NAME KEY`")
    permissions = frozenset(Permission(word.removeprefix("+")) for word in match[5].split())
    return match[3], Grant(match[2], tuple(match[4].split()) or (match[2],), permissions)


def _changed(old: frozenset[Permission], changes: Mapping[Permission, bool | None]) -> list[Permission]:
    return [one for one in Permission if (one in old if changes.get(one) is None else changes[one])]


def _format_line(
    name: str, public: str, agents: Sequence[str] = (), permissions: Iterable[Permission] = ()
) -> str:
    own_only = tuple(agents) == (name,)
    words = ("share-public-key", name, public, *(() if own_only else agents))
    return " ".join((*words, *(f"+{one}" for one in permissions))) + "\n"


def _is_key(text: str) -> bool:
    """Return whether 40 Z85 characters decode to 32 bytes; five characters can exceed four bytes."""
    from zmq.utils import z85

    try:
        return len(z85.decode(text)) == 32
    except struct.error:
        return False


def _checked_name(name: str) -> str:
    if not re.fullmatch(_NAME, name):
        raise UsageError(f"'{name}': a name has 1 to 64 letters, digits, '_', '-' or '.'")
    return name


def _read_text(path: Path) -> str:
    try:
        return read_text(path, MAX_KEYS_BYTES, "ascii")
    except (OSError, UnicodeDecodeError) as error:
        reason = getattr(error, "strerror", None) or "not a text file"
        raise UsageError(f"{path}: cannot be read: {reason}") from None


def _secret_files(folder: Path) -> list[Path]:
    """Return the secret files in `folder`, none if it does not exist. Raises UsageError if it is
    unreadable."""
    try:
        names = os.listdir(folder)  # unlike glob, it raises for an unreadable folder
    except FileNotFoundError:
        return []
    except OSError as error:
        raise UsageError(f"{folder}: cannot be read: {error.strerror}") from None
    return sorted(folder / name for name in names if name.endswith(".secret"))


def _make_folder(folder: Path) -> None:
    try:
        folder.mkdir(mode=0o700, parents=True, exist_ok=True)
    except OSError as error:
        raise UsageError(f"{folder}: cannot be made: {error.strerror}; give another --keys") from None


def _read_lines(path: Path) -> list[_ListLine]:
    """Return the lines of a list, none without a file. Raises UsageError."""
    if not path.exists():
        return []
    lines = []
    for number, text in enumerate(_read_text(path).splitlines(), 1):
        is_comment = not text.strip() or text.startswith("#")
        parsed = () if is_comment else _parse_line(text, f"{path}, line {number}")
        lines.append(_ListLine(text + "\n", *parsed))
    return lines


def _write_list(folder: Path, lines: Iterable[_ListLine]) -> None:
    """Write the list; comments stay in place."""
    atomic_write(folder / _LIST_FILE, "".join(line.text for line in lines))


def _check_not_world_writable(path: Path, status: os.stat_result) -> None:
    """Raises UsageError if any user could authorize keys."""
    if status.st_mode & stat.S_IWOTH and not status.st_mode & stat.S_ISVTX:
        raise UsageError(f"{path}: all users can write to it; `chmod o-w {path}`")
