"""Tests of the registry of systems: systems of installed packages are registered, invalid systems are omitted."""

import json
import re
import sys
from collections.abc import Callable, Iterator
from importlib.metadata import EntryPoint
from pathlib import Path

import pytest
from typer.testing import CliRunner

from marsyard.campaigns.definition import requirements
from marsyard.campaigns.definition.identity import custom_sources
from marsyard.campaigns.definition.loading import load_campaign
from marsyard.campaigns.errors import DefinitionError
from marsyard.cli.app import app
from marsyard.doctor import CheckResult, check_systems
from marsyard.scenarios import declared_columns
from marsyard.scenarios.columns import ENGINE
from marsyard.scenarios.custom_algorithms import shipped_names
from marsyard.scenarios.declared_columns import label, row_columns
from marsyard.scenarios.systems import (
    SCENARIOS_FOLDER,
    UnknownScenarioError,
    catalogue,
    find_system,
    own_paths,
    problems,
    registry,
    scenario,
    scenario_names,
    scenario_paths,
    scenario_source,
    systems,
    templates,
)

CACHED_FUNCTIONS = (
    registry,
    row_columns,
    declared_columns._all_columns,
    declared_columns.find_column,
    declared_columns.label,
    shipped_names,
    requirements.shipped_requirements,
    requirements._read_shipped,
)
HEADER = "from pathlib import Path\nfrom marsyard.scenarios.systems import System\nHERE = Path(__file__).parent\n"
Install = Callable[..., None]


def _clear_caches() -> None:
    for function in CACHED_FUNCTIONS:
        function.cache_clear()


@pytest.fixture
def install(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Install]:
    """Return a function that writes a package with one module and entry points for systems to `sys.path`."""
    monkeypatch.syspath_prepend(str(tmp_path))
    modules: list[str] = []

    def install_package(package: str, source: str, *entry_point_names: str, **files: str) -> None:
        metadata_folder = tmp_path / f"{package}-1.0.dist-info"
        metadata_folder.mkdir()
        (metadata_folder / "METADATA").write_text(f"Metadata-Version: 2.1\nName: {package}\nVersion: 1.0\n")
        entry_points = "".join(f"{entry_point} = {package}:SYSTEM\n" for entry_point in entry_point_names or (package,))
        (metadata_folder / "entry_points.txt").write_text(f"[marsyard.systems]\n{entry_points}")
        (tmp_path / f"{package}.py").write_text(HEADER + source)
        for name, text in files.items():
            path = tmp_path / f"{name}.toml"
            path.parent.mkdir(exist_ok=True)
            path.write_text(text)
        modules.append(package)
        _clear_caches()

    yield install_package
    for module in modules:
        sys.modules.pop(module, None)
    monkeypatch.undo()
    _clear_caches()


def _format_system(name: str, arguments: str = "") -> str:
    """Return a module's source that defines a system with one scenario; `x:Y` is a placeholder of its import path."""
    return f"SYSTEM = System(name={name!r}, title='T', summary='S', scenarios={{'{name}-case': 'x:Y'}}{arguments})\n"


def test_built_in_systems_are_complete() -> None:
    assert not problems()
    assert [entry.name for entry in systems()] == ["dimes", "fieldtest", "hda", "localisation", "measured", "vtt"]
    for system in systems():
        assert system.title, system.name
        assert system.summary.endswith("."), system.name
        for name in system.scenarios:
            assert scenario(name).name == name
            assert find_system(name) is system
            assert row_columns(name) is not None
        for name, path in system.campaigns.items():
            assert catalogue()[name] == path
        assert set(system.compilation_campaigns) <= set(system.campaigns)
    # Each campaign file in the folders belongs to a system.
    assert set(catalogue()) == {path.stem for path in SCENARIOS_FOLDER.glob("*/catalogue/*.toml")}
    assert list(templates()) == ["velocity", "landing", "tracking"]
    assert {"dimes", "vtt", "hda", "homography"} <= shipped_names()


@pytest.mark.parametrize("name", sorted(scenario_paths()))
def test_columns_are_declared_once_with_a_meaning(name: str) -> None:
    columns = row_columns(name)
    assert columns is not None
    declared = [(column.name, column.type) for column in (*columns, *ENGINE)]
    assert len(declared) == len(set(declared))
    assert all(column.meaning for column in columns)
    results = re.compile(
        r"estimat|footprint|touchdown|^site_.|^position_error|^velocity_error|^firing_velocity|inliers|tracks|tracked"
        r"|matche[sd]|^elevation_|_safe$|_unflagged$|_time_s$|residual|nees|(?<!gps)_sd_|^lost|^false|^updates$|^update_"
    )
    assert [
        column.name for column in columns if columns.is_condition(column.name) and results.search(column.name)
    ] == []
    # reports find labels, and texts of flags, by name: declarations of one name agree in all scenarios
    for column in columns:
        found = declared_columns.find_column(column.name)
        assert found is not None
        assert (column.label, column.population) == (found.label, found.population), column.name
        assert column.type is not bool or (column.meaning, column.kind) == (found.meaning, found.kind), column.name


def test_system_of_another_package_is_registered(install: Install) -> None:
    files = ", folder=HERE, columns={'mine-case': 'mine:COLUMNS'}"
    columns_source = "from marsyard.scenarios.columns import Columns, error\n"
    columns_source += "COLUMNS = Columns((error('metres', 'length of a metre'),))\n"
    requirement = 'statement = "S"\nmetric = "metres"\nbound = 1.0\nprobability = 0.9\nconfidence = 0.9\n'
    install(
        "mine",
        columns_source
        + _format_system("mine", files).replace("'x:Y'", "'marsyard.scenarios.measured.matching:MatchingScenario'"),
        **{"catalogue/mine-one": 'scenario = "mine-case"\n'},
        requirements=f'[[requirements]]\nid = "MINE"\n{requirement}',
    )
    assert not problems()
    assert systems()[-1].name == "mine"
    assert "mine-case" in scenario_names()
    assert catalogue()["mine-one"].name == "mine-one.toml"
    assert requirements.shipped_requirements()["MINE"].bound == 1.0
    columns = row_columns("mine-case")
    assert columns is not None
    assert columns.has("metres", float)
    assert label("metres") == "metres"
    campaigns = json.loads(CliRunner().invoke(app, ["list", "--json"]).stdout)
    assert "mine-one" in [entry["name"] for entry in campaigns]


def test_external_scenario_code_is_part_of_the_identity(install: Install, tmp_path: Path) -> None:
    install("mine", _format_system("mine").replace("x:Y", "mine:Case"))
    assert scenario_source("mine-case") == "mine:Case"
    assert list(custom_sources(scenario_source("mine-case"))) == [("mine.py", tmp_path / "mine.py")]
    # Marsyard's own code is hashed completely for each scenario.
    assert scenario_source("descent") == "descent"
    assert list(custom_sources("descent")) == []


@pytest.mark.parametrize(
    ("source", "reason"),
    [
        ("import absent_module\n", "it cannot be imported: No module named 'absent_module'"),
        ("raise RuntimeError('broken')\n", "it cannot be imported: RuntimeError: broken"),
        ("", "has no attribute 'SYSTEM'"),
        ("SYSTEM = {'name': 'mine'}\n", "it is a dict; allowed: a marsyard.scenarios.systems.System"),
        (_format_system("dimes"), "the system 'dimes' already has the name 'dimes'"),
        (_format_system("descent").replace("-case", ""), "the system 'dimes' already has the scenario 'descent'"),
        (
            _format_system("mine", ", templates={'tracking': None}"),
            "the system 'vtt' already has the template 'tracking'",
        ),
        (_format_system("mine", ", folder=HERE"), "the system 'hda' already has the campaign 'hda-map'"),
        (_format_system("mine", ", folder=HERE / 'none'"), "none does not exist"),
    ],
)
def test_invalid_system_does_not_affect_others(install: Install, source: str, reason: str) -> None:
    install("mine", source, **{"catalogue/hda-map": ""})
    install("valid", _format_system("valid"))
    (message,) = problems()
    assert message.startswith("system 'mine' (mine:SYSTEM) is omitted: ")
    assert reason in message
    assert [entry.name for entry in registry().plugins] == ["valid"]
    result = CliRunner().invoke(app, ["list"])
    assert (result.exit_code, result.stderr) == (0, f"warning: {message}\n")
    assert "dimes-smoke" in result.stdout
    checks = list(check_systems())
    assert checks[0].finding.endswith("plug-ins: valid")
    assert [entry.finding for entry in checks if entry.verdict is CheckResult.WARN] == [message]
    with pytest.raises(UnknownScenarioError, match="is omitted"):
        scenario("unknown-scenario")


def test_first_of_two_entry_points_is_used(install: Install) -> None:
    install("mine", _format_system("mine"), "a", "b")
    assert [entry.name for entry in systems()].count("mine") == 1
    assert problems() == ("system 'b' (mine:SYSTEM) is omitted: the system 'mine' already has the name 'mine'",)


def test_entry_point_of_a_system_of_marsyard_adds_nothing(install: Install, monkeypatch: pytest.MonkeyPatch) -> None:
    install("mine", _format_system("mine"))
    points = [EntryPoint(folder, path, "marsyard.systems") for folder, path in own_paths().items()]
    monkeypatch.setattr("marsyard.scenarios.systems.entry_points", lambda group: points)
    assert len(systems()) == len(own_paths())
    assert not problems()


def test_invalid_requirements_file_is_reported(install: Install, tmp_path: Path) -> None:
    install("mine", _format_system("mine", ", folder=HERE"), requirements='[[requirements]]\nid = "MINE"\n')
    assert "DIMES-VEL" in requirements.shipped_requirements()
    campaign = tmp_path / "campaign.toml"
    campaign.write_text('name = "c"\nscenario = "descent"\ncases = 1\n[[requirements]]\nid = "MINE"\n')
    with pytest.raises(DefinitionError, match=r"unknown requirement 'MINE'.*requirements\.toml: .*metric.*required"):
        load_campaign(str(campaign))


def test_invalid_columns_affect_only_campaigns_of_the_system(install: Install, tmp_path: Path) -> None:
    scenario_path = "marsyard.scenarios.measured.matching:MatchingScenario"
    install("mine", _format_system("mine", ", columns={'mine-case': 'mine:HERE'}").replace("x:Y", scenario_path))
    with pytest.raises(ValueError, match=r"mine:HERE is a PosixPath; allowed: a marsyard\.scenarios\.columns\.Columns"):
        row_columns("mine-case")
    assert row_columns("descent") is not None
