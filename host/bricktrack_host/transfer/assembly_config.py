"""``[[assembly]]`` of a fleet file: the components of a cracked brick, and which unit watches which."""

from typing import Annotated, Literal

import msgspec
import numpy as np

from bricktrack_common.errors import ConfigError
from bricktrack_common.poses import Pose
from bricktrack_common.run_manifest import RUN_ID_PATTERN

AssemblyKind = Literal["DCB", "TCB", "QCB"]
N_COMPONENTS: dict[AssemblyKind, int] = {"DCB": 2, "TCB": 3, "QCB": 4}
"""Doubly, triply and quadruply cracked bricks: in so many components."""

_Name = Annotated[str, msgspec.Meta(pattern=RUN_ID_PATTERN)]
_Vector = tuple[float, float, float]


class Component(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """One ``[[assembly.component]]``.

    Attributes
    ----------
    name : str
    point_mm : (float, float, float), mm, brick frame, at rest
        The point whose displacement is reported, as the component's centre.
    """

    name: _Name
    point_mm: _Vector = (0.0, 0.0, 0.0)


class View(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """One ``[[assembly.view]]``: a unit whose camera rides on one component and whose LEDs on another.

    Attributes
    ----------
    unit : str
        As in ``[[unit]]``.
    camera_on, leds_on : str
        Names of components.
    position_brick_layout_mm : (float, float, float), mm
        Where the layout's origin LED sits in the whole brick, from the drawing.
    rotation_brick_layout : 3 x 3
        Takes layout axes to brick axes.
    """

    unit: _Name
    camera_on: _Name
    leds_on: _Name
    position_brick_layout_mm: _Vector
    rotation_brick_layout: tuple[_Vector, _Vector, _Vector] = (
        (1.0, 0.0, 0.0),
        (0.0, 1.0, 0.0),
        (0.0, 0.0, 1.0),
    )

    @property
    def pose_brick_layout(self) -> Pose:
        """Where the layout's frame stands in the whole brick at rest."""
        return Pose(np.array(self.rotation_brick_layout), np.array(self.position_brick_layout_mm))


class AssemblyConfig(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """One ``[[assembly]]``.

    Attributes
    ----------
    name : str
    kind : "DCB", "TCB" or "QCB"
    base : str
        The component that all others are seen from.
    component, view : list
    """

    name: _Name
    kind: AssemblyKind
    base: _Name
    component: list[Component]
    view: Annotated[list[View], msgspec.Meta(min_length=1)]


def check_assembly(assembly: AssemblyConfig, unit_names: list[str], *, where: str) -> None:
    """Make sure that an assembly makes sense, and that every component can be seen from the base.

    Raises
    ------
    ConfigError
        If it has too few or too many components for its kind, a name is unknown or stands twice, a rotation
        is none, or no chain of views leads from the base to a component.
    """
    names = [component.name for component in assembly.component]
    n = N_COMPONENTS[assembly.kind]
    if len(names) != n:
        raise ConfigError(f"{where}.component: {len(names)} of them; a {assembly.kind} is in {n}")
    for list_name, values in (("component", names), ("view", [view.unit for view in assembly.view])):
        for value in values:
            if values.count(value) > 1:
                raise ConfigError(f"{where}.{list_name}: {value!r} stands twice")
    if assembly.base not in names:
        raise ConfigError(f"{where}.base: no component {assembly.base!r}; there are {', '.join(names)}")
    for i, view in enumerate(assembly.view):
        if view.unit not in unit_names:
            raise ConfigError(f"{where}.view[{i}].unit: no unit {view.unit!r} in the fleet")
        for key, name in (("camera_on", view.camera_on), ("leds_on", view.leds_on)):
            if name not in names:
                raise ConfigError(
                    f"{where}.view[{i}].{key}: no component {name!r}; there are {', '.join(names)}"
                )
        if view.camera_on == view.leds_on:
            raise ConfigError(f"{where}.view[{i}]: camera and LEDs are both on {view.leds_on!r}")
        R = np.array(view.rotation_brick_layout)
        if np.abs(R @ R.T - np.eye(3)).max() > 1e-6 or np.linalg.det(R) < 0:
            raise ConfigError(f"{where}.view[{i}].rotation_brick_layout: not a rotation matrix")
    reached = {assembly.base}
    for _ in names:
        for view in assembly.view:
            if view.camera_on in reached or view.leds_on in reached:
                reached |= {view.camera_on, view.leds_on}
    lost = [name for name in names if name not in reached]
    if lost:
        raise ConfigError(
            f"{where}: no chain of views leads from the base {assembly.base!r} to {', '.join(lost)}"
        )
