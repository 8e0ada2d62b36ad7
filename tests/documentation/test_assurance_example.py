"""The packaged example of the guide verifies: hashes, rows and verdicts of four systems."""

from pathlib import Path
from zipfile import ZipFile

from marsyard.reports.assurance.verification import verify_package

EXAMPLE = Path(__file__).parents[2] / "docs/examples/assurance.zip"


def test_example_of_the_four_systems_verifies(tmp_path: Path) -> None:
    with ZipFile(EXAMPLE) as archive:
        archive.extractall(tmp_path)
    folder = tmp_path / "package"
    assert verify_package(folder).problems == ()
    names = {path.name for path in (folder / "runs").iterdir()}
    assert names == {"dimes-smoke", "vtt-montecarlo", "hda-hazardous", "loc-smoke"}
