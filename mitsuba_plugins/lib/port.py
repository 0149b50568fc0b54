"""What the ports of all methods begin with."""

from __future__ import annotations

from abc import ABC, abstractmethod
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from mitsuba_plugins.base import Maps


class Port(ABC):
    """Facts of the maps that stay when their values change; then the maps themselves, by :meth:`update`.

    A convenience: :class:`mitsuba_plugins.protocol.Evaluator` asks for the methods, not for this class.
    """

    def __init__(self, maps: Maps) -> None:
        self.views, self.lights = maps.views, maps.lights
        self.shape, self.filter_type = maps.shape, maps.filter_type
        self.constants = maps.meta["constants"]
        self.update(maps)

    @abstractmethod
    def update(self, maps: Maps) -> None:
        """Take over changed maps."""
