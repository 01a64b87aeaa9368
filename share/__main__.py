"""Where `share` and `python -m share` begin: Ctrl-C is looked after before anything heavy is imported."""

import os
import signal
from types import FrameType


def run() -> None:
    """The command line. Until a command has begun, Ctrl-C ends the program with one line."""
    if signal.getsignal(signal.SIGINT) is signal.default_int_handler:  # not where a script has it ignored
        signal.signal(signal.SIGINT, handle_interrupt)
    from share.cli.main import main

    main()


def handle_interrupt(signal_number: int, frame: FrameType | None) -> None:
    """Exit code 130, as shells give it for SIGINT."""
    os.write(2, b"share: interrupted\n")
    os._exit(130)


if __name__ == "__main__":
    run()
