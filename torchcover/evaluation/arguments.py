"""Arguments that are declared once: as fields of a dataclass, which a function takes and is documented with."""

import inspect
import textwrap
from collections.abc import Callable, Mapping
from functools import update_wrapper
from typing import Annotated, Any, Generic, ParamSpec, TypeVar, get_args, get_origin

GivenT = TypeVar("GivenT")
ValueT = TypeVar("ValueT")
DocumentT = TypeVar("DocumentT")
ReturnT = TypeVar("ReturnT")
Arguments = ParamSpec("Arguments")


class ConvertedField(Generic[GivenT, ValueT]):
    """A field of a dataclass that takes more forms than one, and has one from then on.

    `read`: makes it of what was given; `default`: as it may be given.
    """

    def __init__(self, convert: Callable[[GivenT], ValueT], default: GivenT) -> None:
        self._read = convert
        self._default: Any = default

    def __set_name__(self, owner: type, name: str) -> None:
        self._name = name

    def __get__(self, settings: object, owner: type) -> ValueT:
        value: ValueT = self._default if settings is None else vars(settings)[self._name]
        return value

    def __set__(self, settings: object, given: GivenT) -> None:
        vars(settings)[self._name] = self._read(given)


def accept_fields(
    settings_class: Callable[Arguments, DocumentT], descriptions: Mapping[str, str]
) -> Callable[[Callable[[DocumentT], ReturnT]], Callable[Arguments, ReturnT]]:
    """Decorate a function of one document: it is called with the document's fields, and documented with them.

    Args:
        settings_class: A dataclass; the annotation of a field may hold its description.
        descriptions: Name of a field -> its description, for the others.
    """

    def decorate(function: Callable[[DocumentT], ReturnT]) -> Callable[Arguments, ReturnT]:
        signature = inspect.signature(settings_class)

        def called(*args: Arguments.args, **kwargs: Arguments.kwargs) -> ReturnT:
            try:
                signature.bind(*args, **kwargs)
            except TypeError as error:
                raise TypeError(f"{function.__name__}: {error}") from None
            return function(settings_class(*args, **kwargs))

        update_wrapper(called, function)
        parameters = [each.replace(annotation=_plain(each.annotation)) for each in signature.parameters.values()]
        returns = inspect.signature(function).return_annotation
        called.__signature__ = signature.replace(  # type: ignore[attr-defined]
            parameters=parameters, return_annotation=returns
        )
        called.__annotations__ = {**{each.name: each.annotation for each in parameters}, "return": returns}
        before, returns_line, rest = inspect.cleandoc(function.__doc__ or "").partition("\n\nReturns:")
        called.__doc__ = f"{before}\n\nArgs:\n{_described(signature, descriptions)}{returns_line}{rest}"
        return called

    return decorate


def _plain(annotation: Any) -> Any:  # noqa: ANN401  (a type)
    """What may be given, without the words about it."""
    kind = get_args(annotation)[0] if get_origin(annotation) is Annotated else annotation
    given = get_args(kind)[0] if get_origin(kind) is ConvertedField else kind
    return getattr(given, "__forward_arg__", given)


def _described(signature: inspect.Signature, descriptions: Mapping[str, str]) -> str:
    lines = []
    for name, parameter in signature.parameters.items():
        description = descriptions.get(name) or parameter.annotation.__metadata__[0]
        lines.append(textwrap.fill(f"{name}: {description}", 116, initial_indent=" " * 4, subsequent_indent=" " * 8))
    return "\n".join(lines)
