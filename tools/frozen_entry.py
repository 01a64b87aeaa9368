"""Where the frozen program begins."""

from multiprocessing import freeze_support

freeze_support()  # a spawned worker does its work in here and goes no further

from share.__main__ import run  # noqa: E402

run()
