"""All registration methods by name."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

from mcgicp_jax._methods.base import AbstractMethod
from mcgicp_jax._methods.icp import GICP, ColorICP, PointToPlane, PointToPoint
from mcgicp_jax._methods.multichannel_gicp import MultiChannelGICP
from mcgicp_jax._methods.ndt import D2DNDT, NDT, ColorNDT


@dataclass(frozen=True)
class RegisteredMethod:
    """A class of methods, and the arguments of its constructor that select the method of this name."""

    kind: type[AbstractMethod]
    arguments: Mapping[str, Any] = field(default_factory=dict)

    def __call__(self, **parameters: Any) -> AbstractMethod:
        return self.kind(**self.arguments, **parameters)


METHODS = {
    "mc-gicp": RegisteredMethod(MultiChannelGICP),
    "photometric-gicp": RegisteredMethod(MultiChannelGICP, {"photometric": True}),
    "gicp": RegisteredMethod(GICP),
    "color-icp": RegisteredMethod(ColorICP),
    "point-to-plane": RegisteredMethod(PointToPlane),
    "point-to-point": RegisteredMethod(PointToPoint),
    "ndt": RegisteredMethod(NDT),
    "color-ndt": RegisteredMethod(ColorNDT),
    "d2d-ndt": RegisteredMethod(D2DNDT),
}
