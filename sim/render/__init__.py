"""Pictures of the terrain through exact camera models, and their truth pixel by pixel."""

from sim.render.objects import Objects
from sim.render.photometry import Photometry, Sun, Texture
from sim.render.rays import PixelRays
from sim.render.renderer import Frame, Renderer, Scene, process_renderer

__all__ = [
    "Frame",
    "Objects",
    "Photometry",
    "PixelRays",
    "Renderer",
    "Scene",
    "Sun",
    "Texture",
    "process_renderer",
]
