"""Declares settings: one statement of a field, from which checks, controls, options, keys and tables follow.

The type says the kind, `Range` or `OneOf` in ``Annotated`` the values and the unit, the default what holds unless
something is given, and the docstring below the field is its help::

    @dataclass(frozen=True, slots=True, kw_only=True)
    class TraceConfig:
        hits: Annotated[int, Range(1, 64)] = 8
        \"\"\"Gaussians that a ray collects in a pass.\"\"\"

        __post_init__ = take_fields

`take_fields` checks an object when it is made: numbers of NumPy, arrays without dimensions and values of enums become
plain Python. `settings_of` lists what a class declares; `all_settings` does so with its groups, by names such as
``trace.hits``.
"""

from __future__ import annotations

import ast
import inspect
import math
import re
import sys
import types
from collections.abc import Callable, Mapping
from dataclasses import MISSING, dataclass, field, fields, is_dataclass
from enum import Enum
from functools import cache
from typing import (
    TYPE_CHECKING,
    Annotated,
    Any,
    Literal,
    TypeVar,
    Union,
    cast,
    dataclass_transform,
    get_args,
    get_origin,
    get_type_hints,
    overload,
)

import numpy as np

from lumisplat.config.checks import (
    OneOf,
    Range,
    check_flag,
    check_kind,
    check_text,
    choices,
    enum_member,
    plain,
    quoted,
)
from lumisplat.errors import ConfigError, LumisplatError

if TYPE_CHECKING:
    from _typeshed import DataclassInstance

Kind = Literal["flag", "choice", "whole", "number", "color", "vector", "span", "names", "text", "group", "other"]
Take = Callable[[Any, str], Any]
"""Returns what a field becomes, of a value and the field's name; raises a LumisplatError if the value is refused."""

_Class = TypeVar("_Class")
_Given = TypeVar("_Given")
_Taken = TypeVar("_Taken")


Share = Annotated[float, Range(0.0, 1.0)]
Length = Annotated[float, Range(1e-6, 1e9, "scene units")]
Seed = Annotated[int, Range(0, 2**32 - 1)]
Span = tuple[float, float]
"""The least and the largest value, both included. A single number is both."""
WholeSpan = tuple[int, int]


@overload
def given(*, converter: Callable[[_Given], _Taken], kw_only: bool = False) -> _Taken: ...
@overload
def given(*, converter: Callable[[_Given], _Taken], default: _Given, kw_only: bool = False) -> _Taken: ...
def given(*, converter: Any, default: Any = MISSING, kw_only: bool = False) -> Any:
    """Declares a field that accepts more than what it becomes, such as any array for a vector.

    Args:
        converter: Called with the value and the field's name; returns what the field becomes, or raises a
            LumisplatError. Type checkers take the type of its first parameter for that of the constructor's.
        default: The value if none is given.
        kw_only: Whether it is given by name only.
    """
    return field(default=default, kw_only=kw_only, metadata={"converter": converter})


@overload
def frozen(
    cls: type[_Class], /, *, kw_only: bool = False, eq: bool = False, weakref_slot: bool = False
) -> type[_Class]: ...
@overload
def frozen(
    *, kw_only: bool = False, eq: bool = False, weakref_slot: bool = False
) -> Callable[[type[_Class]], type[_Class]]: ...
@dataclass_transform(frozen_default=True, eq_default=False, field_specifiers=(field, given))
def frozen(cls: Any = None, /, *, kw_only: bool = False, eq: bool = False, weakref_slot: bool = False) -> Any:
    """Makes a class a frozen dataclass with slots, whose fields `given` may declare."""
    make = dataclass(frozen=True, slots=True, kw_only=kw_only, eq=eq, weakref_slot=weakref_slot)
    return make if cls is None else make(cls)


def take_fields(settings: DataclassInstance, prefix: str = "", error: type[LumisplatError] = ConfigError) -> None:
    """Makes the fields of a new object what they declare; the ``__post_init__`` of a class of settings.

    Args:
        settings: The object.
        prefix: Stands before names in messages.
        error: Type of the errors.

    Raises:
        LumisplatError: A value is of the wrong kind or outside its range.
    """
    for name, default, take in _takes(type(settings), error):
        # Tests take the default once.
        if (value := getattr(settings, name)) is not default and (taken := take(value, prefix + name)) is not value:
            object.__setattr__(settings, name, taken)


_ANY = Range()
_SENTENCE_END = re.compile(r"(?<!et al)\. ")


@dataclass(frozen=True)
class Setting:
    """What a class declares of one of its fields."""

    name: str
    """Name of the field."""
    kind: Kind
    """What it is: ``vector`` is three numbers, ``span`` two, ``other`` what nobody types, such as an array."""
    help: str
    """The docstring below the field, on one line, with what each choice means."""
    is_optional: bool = False
    """Whether it may be None, that is automatic."""
    range: Range = _ANY
    """Of numbers, those of spans included."""
    choices: tuple[Enum, ...] = ()
    """The members of its enum."""
    numbers: tuple[int, ...] = ()
    """The few whole numbers that it takes; empty: all in the range."""
    group: type[Any] | None = None
    """The class of a group of fields."""
    default: Any = None
    """The value if none is given; `dataclasses.MISSING` where a value is needed."""
    is_linear: bool = True
    """Whether a colour is linear light; else it is as displays show it."""

    @property
    def low(self) -> float | None:
        """Least number; None: there is none."""
        return self.range.low if math.isfinite(self.range.low) else None

    @property
    def high(self) -> float | None:
        """Largest number; None: there is none."""
        return self.range.high if math.isfinite(self.range.high) else None

    @property
    def expected(self) -> str:
        """The values, in the words of messages: ``a whole number from 1 to 64``; empty where any text is one."""
        match self.kind:
            case "flag":
                return "True or False"
            case "choice":
                return choices(type(self.choices[0]))
            case "whole":
                return OneOf(self.numbers).expected() if self.numbers else self.range.expected(int)
            case "number":
                return self.range.expected()
            case "span":
                return f"two of {self.range.expected()}"
            case _:
                return ""

    @property
    def limits(self) -> str:
        """Range and unit of numbers as a sentence: ``Takes 0.0 to 10.0, in stops.``; empty if there are none."""
        if self.kind not in ("whole", "number", "span") or not (self.range != _ANY or self.numbers):
            return ""
        return f"Takes {self.expected}{self.range.unit and ', in ' + self.range.unit}."


@cache
def settings_of(cls: type) -> tuple[Setting, ...]:
    """Returns what a dataclass declares of its fields, in their order."""
    hints, helps = get_type_hints(cls, include_extras=True), _docstrings(cls)
    return tuple(_setting(one, hints[one.name], helps.get(one.name, "")) for one in fields(cls))


def all_settings(cls: type) -> Mapping[str, Setting]:
    """Returns the settings of a class and of its groups by name, those of groups as ``group.name``."""
    found: dict[str, Setting] = {}
    for one in settings_of(cls):
        if one.group is None:
            found[one.name] = one
        else:
            found |= {f"{one.name}.{name}": inner for name, inner in all_settings(one.group).items()}
    return found


def _setting(one: Any, hint: Any, text: str) -> Setting:
    """Returns what a field declares."""
    default = one.default_factory() if one.default_factory is not MISSING else one.default
    base, limits, is_optional = _declared(hint)
    converter = one.metadata.get("converter")
    kind: Kind = getattr(converter, "kind", None) or _kind(base)
    members = tuple(base) if kind == "choice" else ()
    helps = [text, *_choice_help(base)] if members else [text]
    return Setting(
        one.name,
        kind,
        " ".join(" ".join(helps).replace("`", "").split()),
        is_optional,
        limits if isinstance(limits, Range) else Range(),
        members,
        limits.values if isinstance(limits, OneOf) else (),
        base if kind == "group" else None,
        default,
        getattr(converter, "is_linear", True),
    )


def _declared(hint: Any) -> tuple[Any, Range | OneOf | None, bool]:
    """Returns the plain type of a hint, its limits, and whether None is another value."""
    options = get_args(hint) if get_origin(hint) in (Union, types.UnionType) else (hint,)
    rest = [option for option in options if option is not types.NoneType]
    limits = None
    if len(rest) == 1 and get_origin(rest[0]) is Annotated:
        base, *extras = get_args(rest[0])
        limits = next((extra for extra in extras if isinstance(extra, Range | OneOf)), None)
        inner, _, is_optional = _declared(base)
        return inner, limits, is_optional or len(rest) < len(options)
    return (rest[0] if len(rest) == 1 else hint), limits, len(rest) < len(options)


_KINDS: dict[Any, Kind] = {
    bool: "flag",
    int: "whole",
    float: "number",
    str: "text",
    tuple[str, ...]: "names",
    Span: "span",
    WholeSpan: "span",
    tuple[float, float, float]: "vector",
}


def _kind(base: Any) -> Kind:
    if base in _KINDS:
        return _KINDS[base]
    if isinstance(base, type):
        return "choice" if issubclass(base, Enum) else "group" if is_dataclass(cast(Any, base)) else "other"
    return "other"


@cache
def _takes(cls: type, error: type[LumisplatError]) -> tuple[tuple[str, object, Take], ...]:
    """Returns name, default and check of the fields that have one; made once a class."""
    hints = get_type_hints(cls, include_extras=True)
    found: list[tuple[str, object, Take]] = []
    for one in fields(cls):
        take = one.metadata.get("converter") or _take(hints[one.name], error)
        if take is not None:
            found.append((one.name, one.default, take))
    return tuple(found)


def _take(hint: Any, error: type[LumisplatError]) -> Take | None:
    """Returns what checks and converts values of a type; None: nothing does."""
    base, limits, is_optional = _declared(hint)
    take = _take_kind(base, limits, error)
    if take is None or not is_optional:
        return take
    return lambda value, name: None if value is None else take(value, name)


def _take_kind(  # noqa: PLR0911
    base: Any, limits: Range | OneOf | None, error: type[LumisplatError]
) -> Take | None:
    match _kind(base):
        case "whole" | "number":
            range = Range() if limits is None else limits
            return lambda value, name: range.taken(name, value, base, error)
        case "span":
            assert isinstance(limits, Range)
            return lambda value, name: _span(value, name, limits, get_args(base)[0], error)
        case "flag":
            return lambda value, name: check_flag(name, value, error)
        case "choice":
            return lambda value, name: enum_member(name, value, base, error)
        case "text":
            return lambda value, name: check_text(name, value, error)
        case "group":
            return lambda value, name: check_kind(name, value, base, error)
        case _:
            return None


def _span(value: object, name: str, limits: Range, kind: type, error: type[LumisplatError]) -> Any:
    """Returns the least and the largest value as plain numbers; a single number is both."""
    single = plain(value)
    pair = (single, single) if isinstance(single, int | float) else single
    ends = [plain(end) for end in cast("list[object]", pair)] if isinstance(pair, tuple | list | np.ndarray) else []
    numbers = [end for end in ends if type(end) is int or (kind is float and type(end) is float)]
    if len(ends) != 2 or len(numbers) != 2 or not all(map(limits.holds, numbers)) or numbers[0] > numbers[1]:
        low, high = limits.low, limits.high
        what = f"number, whole ones from {low} to {high}" if kind is int else f"value, {low:g} to {high:g}"
        raise error(f"{name} is {quoted(value)}, expected the least and the largest {what}")
    return kind(numbers[0]), kind(numbers[1])


def _choice_help(cls: type[Enum]) -> list[str]:
    """Returns what each member of an enum means, shortened to its first clause."""
    helps = _docstrings(cls)
    firsts = {name: _SENTENCE_END.split(" ".join(text.split()), 1)[0].rstrip(".") for name, text in helps.items()}
    return [f"{member.value}: {firsts[member.name]}." for member in cls if member.name in firsts]


@cache
def _docstrings(cls: type) -> dict[str, str]:
    """Returns the docstring below each field or member of a class, and of those that it derives from."""
    found: dict[str, str] = {}
    for base in reversed(cls.__mro__[:-1]):
        node = _definitions(base.__module__).get(base.__name__)
        if node is None:  # of Python itself, or made without a file
            continue
        for one, after in zip(node.body, node.body[1:], strict=False):
            target = one.target if isinstance(one, ast.AnnAssign) else None
            if isinstance(one, ast.Assign):
                target = one.targets[0]
            text = after.value.value if isinstance(after, ast.Expr) and isinstance(after.value, ast.Constant) else None
            if isinstance(target, ast.Name) and isinstance(text, str):
                found[target.id] = text
    return found


@cache
def _definitions(module: str) -> dict[str, ast.ClassDef]:
    """Returns the classes that a module's source defines, by name; each source is parsed once, as that takes long."""
    try:
        tree = ast.parse(inspect.getsource(sys.modules[module]))
    except (OSError, TypeError):
        return {}
    return {node.name: node for node in tree.body if isinstance(node, ast.ClassDef)}
