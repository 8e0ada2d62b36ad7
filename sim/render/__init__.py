"""Rendering of the terrain through exact camera models, with ground truth for each pixel."""

from marsyard.sim.render.clouds import CloudLayer, CloudParameters
from marsyard.sim.render.objects import Objects, may_cast_shadow
from marsyard.sim.render.photometry import Photometry
from marsyard.sim.render.pixel_rays import PixelRays
from marsyard.sim.render.renderer import Frame, Renderer, process_renderer
from marsyard.sim.render.scene import Scene
from marsyard.sim.render.sky import DustySky, Sun
from marsyard.sim.render.texture import Texture

__all__ = ["CloudLayer", "CloudParameters", "DustySky", "Frame", "Objects", "Photometry", "PixelRays", "Renderer"]
__all__ += ["Scene", "Sun", "Texture", "may_cast_shadow", "process_renderer"]
