"""Pictures of the terrain through exact camera models, and their truth pixel by pixel."""

from sim.render.clouds import CloudLayer, CloudParameters
from sim.render.objects import Objects
from sim.render.photometry import DustySky, Photometry, Sun, Texture
from sim.render.rays import PixelRays
from sim.render.renderer import Frame, Renderer, process_renderer
from sim.render.rover import may_shade, rover_objects, rover_sphere
from sim.render.scene import Scene

__all__ = [
    "CloudLayer",
    "CloudParameters",
    "DustySky",
    "Frame",
    "Objects",
    "Photometry",
    "PixelRays",
    "Renderer",
    "Scene",
    "Sun",
    "Texture",
    "may_shade",
    "process_renderer",
    "rover_objects",
    "rover_sphere",
]
