from .mitsuba_renderer import MitsubaRenderer as MitsubaRenderer
from .observation import ImageObservation as ImageObservation
from .surface import Surface as Surface, rest_surface as rest_surface
