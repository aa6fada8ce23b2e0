"""What plane sheets of matter do to a particle: scattering angles and energy loss, simulated and by formula."""

from cgemit.matter.passage import LayerNumbers, Passage
from cgemit.matter.send import SlabError, slab

__all__ = ["LayerNumbers", "Passage", "SlabError", "slab"]
