"""Arguments that are declared once: as fields of a document, with their words and their form on the command line."""

import inspect
import textwrap
from collections.abc import Callable
from dataclasses import dataclass, fields
from functools import update_wrapper
from typing import Annotated, Any, Generic, ParamSpec, TypeVar, get_args, get_origin

GivenT = TypeVar("GivenT")
ValueT = TypeVar("ValueT")
DocumentT = TypeVar("DocumentT")
ReturnT = TypeVar("ReturnT")
Arguments = ParamSpec("Arguments")


@dataclass(frozen=True)
class Option:
    """An argument that the command line has as an option of the same name, `torchcover study` too with `in_study`.

    `typed` is its type there, if not that of Python.
    """

    words: str
    typed: Any = None
    minimum: int | None = None
    in_study: bool = False


class Read(Generic[GivenT, ValueT]):
    """A field of a dataclass that takes more forms than one, and has one from then on.

    `read`: makes it of what was given; `default`: as it may be given.
    """

    def __init__(self, read: Callable[[GivenT], ValueT], default: GivenT) -> None:
        self._read = read
        self._default: Any = default

    def __set_name__(self, owner: type, name: str) -> None:
        self._name = name

    def __get__(self, settings: object, owner: type) -> ValueT:
        value: ValueT = self._default if settings is None else vars(settings)[self._name]
        return value

    def __set__(self, settings: object, given: GivenT) -> None:
        vars(settings)[self._name] = self._read(given)


def options_of(document: type) -> dict[str, Option]:
    """Those fields of a document that the command line has, by name."""
    told = {each.name: getattr(each.type, "__metadata__", (None,))[0] for each in fields(document)}
    return {name: option for name, option in told.items() if isinstance(option, Option)}


def taking(
    document: Callable[Arguments, DocumentT],
) -> Callable[[Callable[[DocumentT], ReturnT]], Callable[Arguments, ReturnT]]:
    """A decorator: a function of one document is called with the document's fields, and is documented with them."""

    def decorate(function: Callable[[DocumentT], ReturnT]) -> Callable[Arguments, ReturnT]:
        signature = inspect.signature(document)

        def called(*args: Arguments.args, **kwargs: Arguments.kwargs) -> ReturnT:
            try:
                signature.bind(*args, **kwargs)
            except TypeError as error:
                raise TypeError(f"{function.__name__}: {error}") from None
            return function(document(*args, **kwargs))

        update_wrapper(called, function)
        parameters = [each.replace(annotation=_plain(each.annotation)) for each in signature.parameters.values()]
        returns = inspect.signature(function).return_annotation
        called.__signature__ = signature.replace(  # type: ignore[attr-defined]
            parameters=parameters, return_annotation=returns
        )
        called.__annotations__ = {**{each.name: each.annotation for each in parameters}, "return": returns}
        before, returns_line, rest = inspect.cleandoc(function.__doc__ or "").partition("\n\nReturns:")
        called.__doc__ = f"{before}\n\nArgs:\n{_described(signature)}{returns_line}{rest}"
        return called

    return decorate


def _plain(annotation: Any) -> Any:  # noqa: ANN401  (a type)
    """What may be given, without the words about it."""
    kind = get_args(annotation)[0] if get_origin(annotation) is Annotated else annotation
    given = get_args(kind)[0] if get_origin(kind) is Read else kind
    return getattr(given, "__forward_arg__", given)


def _described(signature: inspect.Signature) -> str:
    lines = []
    for name, parameter in signature.parameters.items():
        said = parameter.annotation.__metadata__[0]
        words = f"{name}: {said.words if isinstance(said, Option) else said}"
        lines.append(textwrap.fill(words, 116, initial_indent=" " * 4, subsequent_indent=" " * 8))
    return "\n".join(lines)
