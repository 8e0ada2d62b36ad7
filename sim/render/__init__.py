"""Pictures of the terrain through exact camera models, and their truth pixel by pixel."""

from sim.render.photometry import Photometry, Sun
from sim.render.renderer import Frame, PixelRays, Renderer, Scene, process_renderer

__all__ = ["Frame", "Photometry", "PixelRays", "Renderer", "Scene", "Sun", "process_renderer"]
