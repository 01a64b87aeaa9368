"""`share sync`: give all machines of a room one clock, and check how well they agree."""

from __future__ import annotations

import json
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import click

from share.cli import options
from share.cli.commands import CommandGroup
from share.cli.terminal import Column, LiveLine, column_table, progress
from share.errors import ShareError, UsageError

if TYPE_CHECKING:
    from share.devices.clocks import ClockCheck
    from share.devices.time_server import TimeServer
    from share.net.udp import HostPort

PORT = 11123  # NTP's own, 123, needs root


@click.group(cls=CommandGroup, prefix="sync ")
def sync() -> None:
    """Give all machines of a room without internet one clock, and check how well they agree.

    \b
    The edge's machine:  share sync server
    Each device:         share sync check 192.168.1.10
                         prints lines for chrony.conf if the clocks differ

    \b
    Example:  share sync check 192.168.1.10 --limit-ms 1
    """


@sync.command(short_help="Serve this machine's time to others.")
@click.option("--bind", default=f"0.0.0.0:{PORT}", metavar="H:P", help="Address to listen on (UDP).")
@click.option(
    "--stratum",
    type=click.IntRange(1, 15),
    default=10,
    help="NTP stratum to announce: distance from a reference clock.",
)
def server(bind: str, stratum: int) -> None:
    """Serve this machine's time to others by NTP (RFC 5905), until Ctrl-C.

    The time is this machine's own, corrected or not: all machines that follow it agree. `share sync check`
    prints the lines for their chrony.conf. If chronyd runs here, it can serve permanently: docs/do/sync.md.

    \b
    Example:  share sync server --bind 0.0.0.0:11123
    """
    from contextlib import closing

    from share.devices.time_server import TimeServer, TimeServerRun
    from share.net.udp import HostPort, StampedSocket, clock_precision, parse_host
    from share.runtime.signals import stop_on_signal

    host = parse_host(bind, PORT, bind=True)
    live = LiveLine()
    with closing(StampedSocket.bind(host)) as link:
        times = TimeServer(stratum, clock_precision())

        def print_line(text: str) -> None:
            live.print_line(f"share sync: {text}")

        run = TimeServerRun(link, times, print_line, lambda: live.write(_counts_text(times)))
        with stop_on_signal(run.stop):
            _print_server(HostPort(host.name, link.port), stratum, link.has_kernel_stamps)
            run.run()
    live.end()
    click.echo(_counts_text(times))


def _print_server(address: HostPort, stratum: int, by_kernel: bool) -> None:
    from share.devices.clocks import follow_lines
    from share.net.udp import HostPort

    stamps = "by the kernel" if by_kernel else "by this program, which is less precise"
    click.echo(f"serving this machine's time at {address} (UDP); requests are timestamped {stamps}", err=True)
    click.echo(f"stratum {stratum}, reference 127.127.1.1 (this machine's own clock)", err=True)
    click.echo(f"clients' chrony.conf: {follow_lines(HostPort('THIS-MACHINE', address.port))[0]}", err=True)


def _counts_text(times: TimeServer) -> str:
    c = times.counts
    clients = f"clients: {times.clients}" + (
        "" if times.last_client is None else f" (last {times.last_client})"
    )
    return f"answered: {c['answered']}, {clients}, rate-limited: {c['limited']}, invalid: {c['ignored']}"


@sync.command(short_help="Measure the clock offsets of other machines.")
@click.argument("hosts", nargs=-1, metavar="[HOSTS]...")
@click.option("--count", type=click.IntRange(1, 1000), default=8, help="Requests per host.")
@click.option(
    "--limit-ms",
    type=click.FloatRange(0, min_open=True),
    default=1.0,
    help="Largest allowed |offset| + uncertainty, ms.",
)
@options.as_json
def check(hosts: tuple[str, ...], count: int, limit_ms: float, as_json: bool) -> None:
    """Measure the offset of time servers' clocks from this machine's, with its uncertainty.

    The offset is theirs minus ours, ± its largest possible error. Exit code 1 if the two together exceed
    --limit-ms for any host. HOSTS are HOST or HOST:PORT; the default port is 11123, that of `share sync
    server` (ntpd and chronyd use 123). Without HOSTS, the state of this machine's chronyd is reported.

    \b
    Example:  share sync check 192.168.1.10 192.168.1.20:123
    """
    from share.devices.clocks import check_chrony, check_servers
    from share.net.udp import parse_host

    addresses = [parse_host(text, PORT) for text in hosts]
    if addresses:
        with progress(count * len(addresses), "asking") as bar:
            rows = check_servers(addresses, count, limit_ms, bar)
    elif (chrony_row := check_chrony(limit_ms)) is not None:
        rows = [chrony_row]
    else:
        raise UsageError(
            "no HOST given and no chronyd runs on this machine; give the host that runs `share sync server`, "
            "such as 192.168.1.10"
        )
    click.echo(json.dumps(_report_values(rows, limit_ms)) if as_json else _table(rows))
    _check_rows(rows, limit_ms)


def _check_rows(rows: Sequence[ClockCheck], limit_ms: float) -> None:
    """Print notes and advice. Raises ShareError if any clock is wrong."""
    for row in rows:
        if row.note:
            click.echo(f"{row.name}: {row.note}", err=True)
    failed = [row for row in rows if row.wrong]
    if not failed:
        click.echo(f"within {limit_ms:g} ms", err=True)
        return
    reference_host = next((row.host for row in failed if row.to_follow), None)
    if reference_host is not None:
        _print_chrony_advice(reference_host)
    if len(rows) == 1:
        raise ShareError(f"{failed[0].name}: {failed[0].wrong}")
    for row in failed:
        click.echo(f"{row.name}: {row.wrong}", err=True)
    raise ShareError(
        f"{len(failed)} of {len(rows)} clocks are not proven to be within {limit_ms:g} ms; see above"
    )


def _print_chrony_advice(host: HostPort) -> None:
    from share.devices.clocks import follow_lines

    click.echo(
        "to follow it: install chrony, append this to /etc/chrony/chrony.conf, restart chrony:", err=True
    )
    for line in follow_lines(host):
        click.echo(f"    {line}", err=True)


def _report_values(rows: Sequence[ClockCheck], limit_ms: float) -> dict[str, Any]:
    return {
        "limit_ms": limit_ms,
        "ok": not any(row.wrong for row in rows),
        "clocks": [r.to_plain() for r in rows],
    }


def _number(value: float | None, form: str) -> str:
    return "–" if value is None else format(value, form)


def _table(rows: Sequence[ClockCheck]) -> str:
    columns: tuple[Column, ...] = (
        ("clock", lambda row: row.name),
        ("offset ms", lambda row: _number(row.offset_ms, "+.3f")),
        ("± ms", lambda row: _number(row.uncertainty_ms, ".3f")),
        ("delay ms", lambda row: _number(row.delay_ms, ".3f")),
        ("jitter ms", lambda row: _number(row.jitter_ms, ".3f")),
        ("stratum", lambda row: _number(row.stratum, "d")),
        ("answers", lambda row: "–" if row.asked is None else f"{row.answers}/{row.asked}"),
        ("took s", lambda row: _number(row.took_s, ".1f")),
    )
    return column_table(columns, rows)
