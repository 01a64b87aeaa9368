"""Files damaged by chance end in a result or in one line, in bounded time and memory."""

import pytest
from helpers.file_fuzzer import fuzz


@pytest.mark.slow
@pytest.mark.parametrize("seed", [1, 2])
def test_files_damaged_by_chance(seed):
    counts, failures = fuzz(120, seed)
    assert not failures, "\n".join(failures)
    assert sum(counts.values()) > 50
