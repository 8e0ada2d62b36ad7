"""Figures of the documentation (distortion, reflectance, sample sizes), drawn with Marsyard's own functions."""

from pathlib import Path

import matplotlib as mpl
import numpy as np
from matplotlib.figure import Figure

from marsyard.reports.statistics.proportions import proportion_lower
from marsyard.sim.camera import CameraModel
from marsyard.sim.render import Photometry
from marsyard.sim.sensor.presets import preset

mpl.rcParams["svg.hashsalt"] = "marsyard"
#: Incidence angle of the sunlight in the figure of the reflectance.
INCIDENCE_DEG = 30.0
#: Reflectance laws by the label in the figure.
LAWS = {
    "Lambert": Photometry(lunar_fraction=0.0, surge_amplitude=0.0),
    "Lommel-Seeliger": Photometry(lunar_fraction=1.0, surge_amplitude=0.0),
    "Lunar-Lambert, Mars": Photometry(surge_amplitude=0.0),
    "with the opposition surge": Photometry(),
}
#: Cameras whose distortion is shown.
CAMERAS = ("mer-descent-flown", "mer-navcam", "mer-hazcam", "xc-55")


def draw_figures(folder: Path) -> None:
    """Write all figures as SVG files."""
    folder.mkdir(exist_ok=True)
    for name, figure in {
        "cameras": draw_distortion(),
        "light": draw_reflectance(),
        "statistics": draw_lower_bounds(),
    }.items():
        figure.savefig(folder / f"{name}.svg", metadata={"Date": None})


def draw_distortion() -> Figure:
    """Draw the radial distortion of the cameras (pixels, relative to a pinhole) over the angle to the optical axis."""
    figure = Figure(figsize=(7.0, 3.6), layout="constrained")
    axes = figure.subplots()
    for name, style in zip(CAMERAS, ("-", "--", "-.", ":"), strict=True):
        angle, distortion_px = _compute_distortion(preset(name).cameras()[0])
        axes.plot(np.degrees(angle), distortion_px, style, label=name)
    axes.axhline(0.0, color="0.7", linewidth=0.8)
    axes.set_yscale("symlog", linthresh=0.1)
    axes.set(xlabel="angle to the optical axis (deg)", ylabel="radial distortion, outward (px)")
    axes.legend(frameon=False)
    return figure


def _compute_distortion(camera: CameraModel) -> tuple[np.ndarray, np.ndarray]:
    """Compute the angles of pixels to the axis, radians, and their radial distortion, pixels.

    The distortion is the distance to the image centre minus the focal length times the tangent of the angle.
    """
    columns = np.linspace(0.5 * camera.size[0], camera.size[0] - 1.0, 200)
    pixels = np.stack([columns, np.full_like(columns, 0.5 * (camera.size[1] - 1))], axis=1)
    directions = camera.rays(pixels)[1]
    # direction along the image row, perpendicular to the axis
    row_chord = camera.rays(pixels[-1])[1] - camera.rays(pixels[0])[1]
    axis = np.asarray(camera.a) / np.linalg.norm(camera.a)
    perpendicular = directions - (directions @ axis)[:, None] * axis
    row_direction = row_chord - (row_chord @ axis) * axis
    tangent = perpendicular @ (row_direction / np.linalg.norm(row_direction)) / (directions @ axis)
    # focal length at the image centre, where the distortion is zero
    focal_px = (columns[1] - columns[0]) / (tangent[1] - tangent[0])
    return np.arctan(tangent), (columns - columns[0]) - focal_px * (tangent - tangent[0])


def draw_reflectance() -> Figure:
    """Draw the radiance factor of level ground of unit albedo in direct sunlight over the emission angle."""
    emission = np.radians(np.linspace(-85.0, 85.0, 681))
    incidence = np.radians(INCIDENCE_DEG)
    phase = np.abs(emission - incidence)
    figure = Figure(figsize=(7.0, 3.6), layout="constrained")
    axes = figure.subplots()
    for (name, law), style in zip(LAWS.items(), ("-", "--", "-.", ":"), strict=True):
        surge = 1.0 + law.surge_amplitude / (1.0 + np.tan(phase / 2.0) / law.surge_width)
        lunar = 2.0 * law.lunar_fraction * np.cos(incidence) / (np.cos(incidence) + np.cos(emission))
        lambert = (1.0 - law.lunar_fraction) * np.cos(incidence)
        axes.plot(np.degrees(emission), law.normalisation() * surge * (lunar + lambert), style, label=name)
    axes.axvline(INCIDENCE_DEG, color="0.7", linewidth=0.8)
    axes.set(
        xlabel="emission angle towards the sun (deg); the line: sun behind the camera", ylabel="I/F divided by albedo"
    )
    axes.legend(frameon=False)
    return figure


def draw_lower_bounds() -> Figure:
    """Draw the lower bound of the success rate at 90 % confidence over the number of cases, for 0 to 3 failures."""
    cases = np.unique(np.geomspace(10, 2000, 120).astype(int))
    figure = Figure(figsize=(7.0, 3.6), layout="constrained")
    axes = figure.subplots()
    for failures, style in enumerate(("-", "--", "-.", ":")):
        bounds = [100.0 * proportion_lower(int(number) - failures, int(number), 0.9) for number in cases]
        axes.semilogx(cases, bounds, style, label=f"{failures} failed")
    axes.axhline(99.0, color="0.7", linewidth=0.8)
    axes.text(11, 99.15, "99 % required", color="0.35")
    axes.set(xlabel="cases", ylabel="lower bound of success rate (%)", ylim=(80, 100.5))
    axes.legend(frameon=False)
    return figure
