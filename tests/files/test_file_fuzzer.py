"""Randomly damaged files give a result or one line, in bounded time and memory."""

import pytest
from helpers.file_fuzzer import fuzz


@pytest.mark.slow
@pytest.mark.parametrize("seed", [1, 2])
def test_randomly_damaged_files_give_a_result_or_one_line(seed):
    counts, failures = fuzz(120, seed)
    assert not failures, "\n".join(failures)
    assert sum(counts.values()) > 50
