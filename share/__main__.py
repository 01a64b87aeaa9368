"""Entry point of `share` and `python -m share`. It handles Ctrl-C before anything heavy is imported."""

import os
import signal
from types import FrameType


def run() -> None:
    """Run the command line. Until a command has started, Ctrl-C ends the program with one line."""
    if signal.getsignal(signal.SIGINT) is signal.default_int_handler:  # not if a script ignores it
        signal.signal(signal.SIGINT, handle_interrupt)
    from share.cli.main import main

    main()


def handle_interrupt(signal_number: int, frame: FrameType | None) -> None:
    """Exit with code 130, the shells' code for SIGINT."""
    os.write(2, b"share: interrupted\n")
    os._exit(130)


if __name__ == "__main__":
    run()
