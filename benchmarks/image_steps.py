"""Steps of one image: ``python -m benchmarks.image_steps`` draws docs/images/image-steps.png."""

from dataclasses import replace
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure

from marsyard.scenarios.views import SiteGround, Viewpoint, mast_pose, site_scene
from marsyard.sim.camera import Cahv
from marsyard.sim.frames import direction
from marsyard.sim.render import Frame, PixelRays, Scene, Sun, Texture, process_renderer
from marsyard.sim.render.backend import default_backend
from marsyard.sim.render.scene import NO_RELIEF
from marsyard.sim.terrain.sites import site

FILE = Path(__file__).parents[1] / "docs" / "images" / "image-steps.png"
#: Position of the mast's foot (east, north) and height of the camera, metres.
EAST_M, NORTH_M, HEIGHT_M = 14.0, 20.0, 1.5
SUN = Sun(direction(np.radians(60.0), np.radians(30.0)))


def render_steps() -> dict[str, tuple[np.ndarray, str]]:
    """Render a view from a mast; return images and their colour maps by title, from the first step to the last."""
    camera = Cahv.from_field_of_view(0.7, (360, 240), axis=np.array([1.0, 0.0, 0.0]), right=np.array([0.0, -1.0, 0.0]))
    rays = PixelRays.from_camera(camera)
    ground = SiteGround.from_site(site("gusev"), "ground")
    final = site_scene(ground, Viewpoint(EAST_M, NORTH_M, HEIGHT_M, rays.pixel_rad, 25.0), SUN)
    pose = mast_pose(ground.surface, EAST_M, NORTH_M, HEIGHT_M, 120.0, -14.0)

    def render(scene: Scene) -> Frame:
        return process_renderer(default_backend()).render(scene, rays, pose)

    smooth = replace(final, relief=NO_RELIEF, ground_texture=Texture(), object_texture=Texture(), edge_rays=1)
    # without casters: the light of a sun whose shadows are not computed
    unshadowed = replace(smooth, ground_shadows=False)
    unshadowed.__dict__["occluders"] = replace(smooth.occluders, shadow=None, casters=None)
    truth = render(smooth)
    return {
        "distance": (np.log(np.where(np.isfinite(truth.range_m), truth.range_m, np.nan)), "viridis"),
        "normal (east)": (truth.normal[..., 0], "coolwarm"),
        "reflectance without shadows": (render(unshadowed).radiance, "gray"),
        "with shadows": (truth.radiance, "gray"),
        "with relief and texture": (render(replace(final, edge_rays=1)).radiance, "gray"),
        "with several rays at edges": (render(final).radiance, "gray"),
    }


def draw_steps(file: Path) -> None:
    """Draw all steps in one figure."""
    figure = Figure(figsize=(9.0, 4.4), layout="constrained")
    steps = render_steps()
    brightest = float(np.quantile(steps["with shadows"][0], 0.995))
    for axes, (title, (image, colours)) in zip(figure.subplots(2, 3).flat, steps.items(), strict=True):
        limits = {"vmin": 0.0, "vmax": brightest} if colours == "gray" else {}
        axes.imshow(image, cmap=colours, **limits)
        axes.set_title(title, fontsize=9)
        axes.set_axis_off()
    figure.savefig(file, dpi=80)


if __name__ == "__main__":
    draw_steps(FILE)
