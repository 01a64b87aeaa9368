"""Entry point of the frozen program."""

from multiprocessing import freeze_support

freeze_support()  # a spawned worker runs in here and does not return

from share.__main__ import run  # noqa: E402

run()
