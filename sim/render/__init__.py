"""Rendering of the terrain through exact camera models, with ground truth for each pixel."""

from marsyard.sim.render.objects import Objects, may_cast_shadow
from marsyard.sim.render.photometry import CloudLayer, CloudParameters, DustySky, Photometry, Sun, Texture
from marsyard.sim.render.rays import PixelRays
from marsyard.sim.render.renderer import Frame, Renderer, process_renderer
from marsyard.sim.render.scene import Scene

__all__ = ["CloudLayer", "CloudParameters", "DustySky", "Frame", "Objects", "Photometry", "PixelRays", "Renderer"]
__all__ += ["Scene", "Sun", "Texture", "may_cast_shadow", "process_renderer"]
