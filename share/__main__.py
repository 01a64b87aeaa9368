"""`python -m share` is `share`."""

from share.cli.main import main

main()
