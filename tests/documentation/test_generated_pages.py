"""Tests of the generated tables: they list every key that the pages name in ``--set KEY=VALUE``."""

import re

import pytest

from docs import pages
from marsyard.scenarios.systems import scenario_names
from tests.documentation.test_links import PAGES

#: Keys of the modules and files that pages use as examples, and of the campaign itself.
EXAMPLE_KEYS = ("flight.options.", "dispersions.")


def read_keys(name: str) -> set[str]:
    return set(re.findall(r"^\| `([^`]+)`", pages.format_parameters(name), re.MULTILINE))


def test_options_of_algorithms_are_listed_with_their_descriptions() -> None:
    rows = {line.split("`")[1]: line for line in pages.format_parameters("landing").splitlines() if "| `hda." in line}
    assert rows["hda.track_seed"].startswith(
        "| `hda.track_seed` | `unchanged` or `poses` | `unchanged` | Start of the "
    )
    # two options with one description
    for name, default in (("max_tilt_change_rad", "0.349066"), ("max_roll_change_rad", "0.174533")):
        assert rows[f"hda.{name}"].startswith(f"| `hda.{name}` | number | `{default}` | Limits of the image pairs: ")
    # options within options
    assert "lvs.imu.gyro_bias_deg_h" in read_keys("localisation")


@pytest.mark.parametrize("name", scenario_names())
def test_types_of_parameters_are_words(name: str) -> None:
    """A class name in the column of types means that the keys of its table are missing."""
    assert re.findall(r"^\| `[^`]+` \| `[A-Z]\w*[a-z]\w*`", pages.format_parameters(name), re.MULTILINE) == []


def test_keys_of_commands_exist() -> None:
    named = {
        key
        for page in PAGES
        for key in re.findall(r"--set ['\"]?([a-z_][\w.]*)=", page.read_text(encoding="utf-8"))
        if not key.startswith(EXAMPLE_KEYS)
    }
    assert len(named) > 15
    assert named - {key for name in scenario_names() for key in read_keys(name)} == set()
