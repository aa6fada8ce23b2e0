"""What plane layers of matter do to a particle: scattering angles and energy loss, simulated and by formula."""

from cgemit.matter.result import LayerNumbers, SlabResult
from cgemit.matter.send import SlabError, slab

__all__ = ["LayerNumbers", "SlabError", "SlabResult", "slab"]
