"""Declares settings once: checks, viewer controls, options, TOML keys and table rows follow from the declaration.

The type states the kind, `Range` or `OneOf` in ``Annotated`` the accepted values and their unit, and the docstring
below the field its help::

    @dataclass(frozen=True, slots=True, kw_only=True)
    class TraceConfig:
        hits: Annotated[int, Range(1, 64)] = 8
        \"\"\"Gaussians that a ray collects in a pass.\"\"\"

        __post_init__ = take_fields

`take_fields` checks new objects, and converts NumPy numbers, zero-dimensional arrays and values of enums to Python
types. `settings_of` lists the fields of a class; `all_settings` includes those of its groups, by names such as
``trace.hits``.
"""

from __future__ import annotations

import ast
import inspect
import math
import re
import sys
import textwrap
import types
from collections.abc import Callable, Iterable, Mapping
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
    refusal,
)
from lumisplat.errors import ConfigError, LumisplatError

if TYPE_CHECKING:
    from _typeshed import DataclassInstance

Kind = Literal["flag", "choice", "whole", "number", "color", "vector", "span", "names", "text", "group", "other"]
Take = Callable[[Any, str], Any]
"""Function from a value and the field's name to the value of the field; raises a LumisplatError if it is refused."""

_Class = TypeVar("_Class")
_Given = TypeVar("_Given")
_Taken = TypeVar("_Taken")


Share = Annotated[float, Range(0.0, 1.0)]
Length = Annotated[float, Range(1e-6, 1e9, "scene units")]
Seed = Annotated[int, Range(0, 2**32 - 1)]
Span = tuple[float, float]
"""Smallest and largest value, both included. A single number stands for both."""
WholeSpan = tuple[int, int]


@overload
def given(*, converter: Callable[[_Given], _Taken], kw_only: bool = False) -> _Taken: ...
@overload
def given(*, converter: Callable[[_Given], _Taken], default: _Given, kw_only: bool = False) -> _Taken: ...
def given(*, converter: Any, default: Any = MISSING, kw_only: bool = False) -> Any:
    """Declares a field that accepts more types than it stores, such as any array for a vector.

    Args:
        converter: Function from the value and the field's name to the stored value; it raises a LumisplatError if the
            value is refused. Type checkers use the type of its first parameter for the constructor.
        default: The value if none is given.
        kw_only: Whether the field is keyword-only.
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
    """Makes a class a frozen dataclass with slots, in which `given` may declare fields."""
    make = dataclass(frozen=True, slots=True, kw_only=kw_only, eq=eq, weakref_slot=weakref_slot)
    return make if cls is None else make(cls)


def take_fields(settings: DataclassInstance, prefix: str = "", error: type[LumisplatError] = ConfigError) -> None:
    """Checks and converts the fields of a new object; the ``__post_init__`` of settings classes.

    Args:
        settings: The object.
        prefix: Text before the names in messages.
        error: Type of the errors.

    Raises:
        LumisplatError: A value has the wrong type or is outside its range.
    """
    for name, default, take in _takes(type(settings), error):
        # The default is checked once, in tests.
        if (value := getattr(settings, name)) is not default and (taken := take(value, prefix + name)) is not value:
            object.__setattr__(settings, name, taken)


_ANY = Range()
_DOC_WIDTH = 100
"""Width, in characters, of the list of fields in a class docstring."""
_SENTENCE_END = re.compile(r"(?<!et al)\. ")


@dataclass(frozen=True)
class Setting:
    """Declaration of one setting, read from a dataclass field: its name, accepted values, help and default."""

    name: str
    """Name of the field."""
    kind: Kind
    """Type of the accepted values. ``vector`` is three numbers, ``span`` a smallest and a largest number, and
    ``other`` anything without a type that options could show, such as arrays."""
    help: str
    """Docstring below the field on one line, followed by the meaning of each choice."""
    is_optional: bool = False
    """True if the value may be None, which means automatic."""
    range: Range = _ANY
    """Range that the number, or both numbers of a span, must be in."""
    choices: tuple[Enum, ...] = ()
    """Members of the field's enum that the setting accepts; empty if the field is no enum."""
    numbers: tuple[int, ...] = ()
    """The few integers that the field accepts; empty if it accepts all of the range."""
    group: type[Any] | None = None
    """Settings class of a field that holds a whole group of settings; None for a single setting."""
    default: Any = None
    """Default value; `dataclasses.MISSING` if a value is required."""
    is_linear: bool = True
    """True if a colour setting is linear, False if it is display-referred sRGB."""

    @property
    def low(self) -> float | None:
        """Smallest accepted number; None if there is no lower limit."""
        return self.range.low if math.isfinite(self.range.low) else None

    @property
    def high(self) -> float | None:
        """Largest accepted number; None if there is no upper limit."""
        return self.range.high if math.isfinite(self.range.high) else None

    @property
    def expected(self) -> str:
        """Accepted values in the words of messages, ``a whole number from 1 to 64``; empty if any text is accepted."""
        match self.kind:
            case "flag":
                return "True or False"
            case "choice":
                return choices(self.choices)
            case "whole":
                return OneOf(self.numbers).expected() if self.numbers else self.range.expected(int)
            case "number":
                return self.range.expected()
            case "span":
                return f"two of {self.range.expected()}"
            case _:
                return ""

    @property
    def described(self) -> str:
        """Help, accepted values and default, a sentence each."""
        default = "" if self.default is MISSING or self.group else f"Default: {_shown(self.default)}."
        return " ".join(filter(None, (self.help, self.limits, default)))

    @property
    def limits(self) -> str:
        """Range and unit of numbers as a sentence, ``Takes 0.0 to 10.0, in stops.``; empty for other kinds."""
        if self.kind not in ("whole", "number", "span") or not (self.range != _ANY or self.numbers):
            return ""
        return f"Takes {self.expected}{self.range.unit and ', in ' + self.range.unit}."


def _shown(value: object) -> str:
    """Returns a default value as a user of Python types it."""
    return repr(value.value if isinstance(value, Enum) else value)


@cache
def settings_of(cls: type) -> tuple[Setting, ...]:
    """Returns the declarations of a dataclass's fields, in their order."""
    hints, helps = get_type_hints(cls, include_extras=True), docstrings_of(cls)
    return tuple(_setting(one, hints[one.name], helps.get(one.name, "")) for one in fields(cls))


def all_settings(cls: type) -> Mapping[str, Setting]:
    """Returns the settings of a class and of its groups by name; settings of groups are named ``group.name``."""
    found: dict[str, Setting] = {}
    for one in settings_of(cls):
        if one.group is None:
            found[one.name] = one
        else:
            found |= {f"{one.name}.{name}": inner for name, inner in all_settings(one.group).items()}
    return found


class FieldDocs:
    """Descriptor of ``__doc__``: the class docstring, followed by all fields with their docstrings, for ``help``.

    The text is built at the first access, because the docstrings below fields have to be parsed from the source.

    Args:
        text: The docstring in the source.
    """

    def __init__(self, text: str) -> None:
        self._text = text

    def __get__(self, instance: object, cls: type) -> str:
        wrapped = textwrap.TextWrapper(
            _DOC_WIDTH,
            initial_indent=4 * " ",
            subsequent_indent=8 * " ",
            break_on_hyphens=False,
            break_long_words=False,
        )
        rows = [wrapped.fill(f"{one.name}: {one.described}") for one in settings_of(cls)]
        return "\n".join([inspect.cleandoc(self._text), "", "Attributes:", *rows])


def document_fields(*classes: type) -> None:
    """Adds the fields to the docstrings of settings classes: see `FieldDocs`."""
    for cls in classes:
        cls.__doc__ = FieldDocs(cls.__doc__ or "")  # pyright: ignore[reportAttributeAccessIssue]


def _setting(one: Any, hint: Any, text: str) -> Setting:
    """Returns the `Setting` of a dataclass field from its type hint and its docstring ``text``."""
    default = one.default_factory() if one.default_factory is not MISSING else one.default
    base, limits, is_optional = _declared(hint)
    converter = one.metadata.get("converter")
    kind: Kind = getattr(converter, "kind", None) or _kind(base)
    values: tuple[Any, ...] = limits.values if isinstance(limits, OneOf) else ()
    members = values or tuple(base) if kind == "choice" else ()
    helps = [text, *_choice_help(base, members)] if members else [text]
    return Setting(
        one.name,
        kind,
        " ".join(" ".join(helps).replace("`", "").split()),
        is_optional,
        limits if isinstance(limits, Range) else Range(),
        members,
        () if members else values,
        base if kind == "group" else None,
        default,
        getattr(converter, "is_linear", True),
    )


def _declared(hint: Any) -> tuple[Any, Range | OneOf | None, bool]:
    """Splits a type hint into the plain type, its `Range` or `OneOf` (None without), and whether it accepts None."""
    options = get_args(hint) if get_origin(hint) in (Union, types.UnionType) else (hint,)
    plain_types = [option for option in options if option is not types.NoneType]
    limits = None
    if len(plain_types) == 1 and get_origin(plain_types[0]) is Annotated:
        base, *extras = get_args(plain_types[0])
        limits = next((extra for extra in extras if isinstance(extra, Range | OneOf)), None)
        inner, _, is_optional = _declared(base)
        return inner, limits, is_optional or len(plain_types) < len(options)
    return (plain_types[0] if len(plain_types) == 1 else hint), limits, len(plain_types) < len(options)


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
    """Returns (name, default, converter) of each field of a class that has a converter; cached for each class."""
    hints = get_type_hints(cls, include_extras=True)
    found: list[tuple[str, object, Take]] = []
    for one in fields(cls):
        take = one.metadata.get("converter") or _take(hints[one.name], error)
        if take is not None:
            found.append((one.name, one.default, take))
    return tuple(found)


def _take(hint: Any, error: type[LumisplatError]) -> Take | None:
    """Returns the function that checks and converts values of a type hint; None for types that are not checked."""
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
            members: Any = limits.values if isinstance(limits, OneOf) else base
            return lambda value, name: enum_member(name, value, members, error)
        case "text":
            return lambda value, name: check_text(name, value, error)
        case "group":
            return lambda value, name: check_kind(name, value, base, error)
        case _:
            return None


def _span(value: object, name: str, limits: Range, kind: type, error: type[LumisplatError]) -> Any:
    """Converts a pair of numbers, or one number that stands for both, to (smallest, largest) within ``limits``."""
    single = plain(value)
    pair = (single, single) if isinstance(single, int | float) else single
    ends = [plain(end) for end in cast("list[object]", pair)] if isinstance(pair, tuple | list | np.ndarray) else []
    numbers = [end for end in ends if type(end) is int or (kind is float and type(end) is float)]
    if len(ends) != 2 or len(numbers) != 2 or not all(map(limits.holds, numbers)) or numbers[0] > numbers[1]:
        low, high = limits.low, limits.high
        what = f"number, whole ones from {low} to {high}" if kind is int else f"value, {low:g} to {high:g}"
        raise refusal(error, name, value, f"expected the smallest and the largest {what}")
    return kind(numbers[0]), kind(numbers[1])


def _choice_help(cls: type[Enum], members: Iterable[Enum]) -> list[str]:
    """Returns one text per enum member: its value and the first sentence of its docstring."""
    helps = docstrings_of(cls)
    firsts = {name: _SENTENCE_END.split(" ".join(text.split()), 1)[0].rstrip(".") for name, text in helps.items()}
    return [f"{member.value}: {firsts[member.name]}." for member in members if member.name in firsts]


@cache
def docstrings_of(cls: type) -> dict[str, str]:
    """Returns the docstrings below the fields or members of a class, including inherited ones, by name."""
    found: dict[str, str] = {}
    for base in reversed(cls.__mro__[:-1]):
        node = _definitions(base.__module__).get(base.__name__)
        if node is None:  # a class of Python itself, or without a source file
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
    """Returns the class definitions in a module's source by name; cached, as parsing is slow."""
    try:
        tree = ast.parse(inspect.getsource(sys.modules[module]))
    except (OSError, TypeError):
        return {}
    return {node.name: node for node in tree.body if isinstance(node, ast.ClassDef)}
