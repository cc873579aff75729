"""Scene objects as tables: reading a table restores the object exactly."""

from __future__ import annotations

import math
import tomllib
from dataclasses import fields
from pathlib import Path
from typing import Any, cast

import numpy as np
import pytest
from hypothesis import given, strategies as st

import lumisplat as ls
from lumisplat.io.document.tables import light_table
from lumisplat.io.scene_toml.lights import read_environment, read_light
from lumisplat.io.scene_toml.toml_table import TomlTable, toml_text
from lumisplat.scene.placing import up_vector
from support.kinds import expect_kind

SIGNED = st.floats(-1e3, 1e3)
POSITIVE = st.floats(1e-3, 1e3)
POINT = st.tuples(SIGNED, SIGNED, SIGNED)
DIRECTION = POINT.filter(lambda v: max(map(abs, v)) > 1e-3)
COLOR = st.tuples(*[st.floats(0.0, 10.0)] * 3)
SHARED = {"enabled": st.booleans(), "casts_shadow": st.booleans(), "name": st.text(max_size=5)}
FAR = st.just(math.inf) | POSITIVE


@st.composite
def spots(draw: st.DrawFn) -> ls.LightSpot:
    """Generates spot lights with all angles, also with an inner angle one float below the outer one."""
    outer = draw(st.just(math.pi / 2) | st.floats(1e-3, math.pi / 2))
    inner = draw(st.just(math.nextafter(outer, 0.0)) | st.floats(0.0, outer, exclude_max=True))
    return ls.LightSpot(draw(POINT), draw(DIRECTION), inner_angle=inner, outer_angle=outer, range=draw(FAR))


LIGHTS: st.SearchStrategy[Any] = st.one_of(
    st.builds(ls.LightPoint, POINT, COLOR, POSITIVE, FAR, POSITIVE, **SHARED),
    spots(),
    st.builds(
        ls.LightDirectional,
        DIRECTION,
        angle=st.floats(0.0, math.pi / 2),
        shadow_distance=FAR,
        **cast(dict[str, Any], SHARED),
    ),
    st.builds(ls.LightSphere, POINT, POSITIVE, COLOR, POSITIVE, visible=st.booleans(), **SHARED),
    st.builds(ls.LightDisk, POINT, DIRECTION, POSITIVE, COLOR, POSITIVE, visible=st.booleans(), **SHARED),
    st.builds(lambda p, s, name: ls.LightRect(p, (s, 0.1, 0.0), (0.0, 1.0, s), name=name), POINT, POSITIVE, st.text()),
    st.builds(
        ls.LightEnvironment,
        st.none(),
        COLOR,
        POSITIVE,
        st.tuples(SIGNED, SIGNED, SIGNED, SIGNED).filter(lambda q: max(map(abs, q)) > 1e-3),
        st.booleans(),
        shadow_distance=FAR,
        **cast(dict[str, Any], SHARED),
    ),
)


@given(LIGHTS)
def test_light_written_as_a_scene_file_table_is_restored_exactly(light: Any) -> None:
    """Lights of all types are equal after TOML text; angles, stored in degrees, may differ by one float."""
    table = TomlTable.of(Path("scene.toml"), tomllib.loads(toml_text(light_table(light))))
    found = read_environment(table) if isinstance(light, ls.LightEnvironment) else read_light(table)
    assert type(found) is type(light)
    for field in fields(light):
        mine, same = getattr(found, field.name), getattr(light, field.name)
        if field.name.endswith("angle"):
            assert mine in (same, math.nextafter(same, -1.0), math.nextafter(same, 4.0)), field.name
        else:
            assert mine == same, field.name


@given(DIRECTION)
def test_normalizing_an_up_direction_twice_changes_nothing(direction: tuple[float, float, float]) -> None:
    """A file that is saved and read repeatedly keeps its up direction."""
    assert up_vector(up_vector(direction)) == up_vector(direction)


def test_documents_write_numpy_numbers_as_toml_numbers() -> None:
    """The intensity is a NumPy float; a spot slightly wider than a hemisphere is saved as a hemisphere."""
    light = ls.LightPoint(np.zeros(3), intensity=cast(Any, np.float32(0.1)), enabled=cast(Any, np.bool_(False)))
    wide = ls.LightSpot((0, 0, 0), (0, 0, 1), outer_angle=math.pi / 2 + 5e-7)
    first, second = ls.io.SceneDocument.of(ls.Scene(lights=[light, wide])).scene().lights
    assert first.intensity == np.float32(0.1) and first.enabled is False
    assert expect_kind(ls.LightSpot, second).outer_angle == math.pi / 2


@pytest.mark.parametrize("order", [(0, 1), (1, 0)])
def test_document_with_several_environments_saves_only_the_enabled_one(order: tuple[int, int], tmp_path: Path) -> None:
    """A scene may have several environments, a scene file only a single one."""
    environments = [ls.LightEnvironment(intensity=1.0, enabled=False), ls.LightEnvironment(intensity=5.0)]
    document = ls.io.SceneDocument.of(ls.Scene(lights=[environments[k] for k in order]))
    document.save(tmp_path / "scene.toml")
    for scene in (document.scene(), expect_kind(ls.Scene, ls.load(tmp_path / "scene.toml"))):
        assert [(environment.intensity, environment.enabled) for environment in scene.lights] == [(5.0, True)]


def test_document_edits_accept_arrays_tuples_and_paths() -> None:
    """The document copies the given values, and its tables are read-only."""
    document, number = ls.io.SceneDocument.of(ls.Scene()).added("lights", {"type": "point", "position": (1, 2, 3)})
    position = np.array([4.0, 5.0, 6.0])
    document = document.changed(number, position=position, intensity=np.float64(2.0))
    position[0] = 99.0
    assert document.entry(number).table == {"type": "point", "position": [4.0, 5.0, 6.0], "intensity": 2.0}
    assert tomllib.loads(document.toml())["lights"] == [dict(document.entry(number).table)]
    with pytest.raises(TypeError, match="does not support item assignment"):
        cast(Any, document.entry(number).table)["intensity"] = 7.0
    with pytest.raises(ls.FormatError, match="no such file"):
        document.added("splats", {"path": Path("gone.ply")})
    assert [c.name for c in document.with_cameras([{"name": "a", "eye": (0, 0, 1), "target": np.zeros(3)}]).cameras]


@pytest.mark.parametrize("matrix", [np.eye(3), np.zeros((4, 4)), np.full((4, 4), np.nan), "here"])
def test_documents_refuse_invalid_transforms_with_a_one_line_error(matrix: Any) -> None:
    """The transform is a 3 x 3 matrix, a zero matrix, NaN or text."""
    document = ls.io.SceneDocument.of(ls.Scene(meshes=[ls.box(1.0)]))
    with pytest.raises(ls.SceneError, match="world_from_file"):
        document.placed(0, matrix)
