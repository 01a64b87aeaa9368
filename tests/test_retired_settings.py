"""Each former setting is refused by a line that names its constant, which exists."""

from __future__ import annotations

import importlib

import pytest

from share.config import Config, load_config
from share.errors import ConfigError
from share.retired_settings import RETIRED_SETTINGS


@pytest.mark.parametrize(("setting", "constant"), RETIRED_SETTINGS.items())
def test_a_retired_setting_names_its_constant(setting: str, constant: str) -> None:
    section, key = setting.split(".")
    module, _, name = constant.rpartition(".")
    assert hasattr(importlib.import_module(f"share.{module}"), name)
    assert not hasattr(getattr(Config(), section, None), key)
    with pytest.raises(
        ConfigError, match=f"room.yaml: {setting} is no longer a setting: it is {name} in share/"
    ):
        load_config(f"{section}: {{{key}: 1}}", "room.yaml")
