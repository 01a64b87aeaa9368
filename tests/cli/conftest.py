"""What tests of commands share."""

from collections.abc import Callable

import pytest
from shell import Done

from share.cli.main import main


@pytest.fixture
def share(capsys) -> Callable[..., Done]:
    """`share ARGUMENTS` within this process."""

    def run(*arguments: object) -> Done:
        with pytest.raises(SystemExit) as end:
            main([str(argument) for argument in arguments])
        assert isinstance(end.value.code, int)
        return Done(end.value.code, *capsys.readouterr())

    return run
