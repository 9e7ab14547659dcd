"""Arguments that are declared once, as fields of a dataclass, and become the parameters of a function."""

import inspect
import textwrap
from collections.abc import Callable, Mapping
from functools import update_wrapper
from typing import Annotated, Any, Generic, ParamSpec, TypeVar, get_args, get_origin

InputT = TypeVar("InputT")
ValueT = TypeVar("ValueT")
SettingsT = TypeVar("SettingsT")
ReturnT = TypeVar("ReturnT")
Arguments = ParamSpec("Arguments")


class ConvertedField(Generic[InputT, ValueT]):
    """Field of a dataclass that accepts several forms and stores one.

    Args:
        convert: Function from an accepted form to the stored form.
        default: Default, in an accepted form.
    """

    def __init__(self, convert: Callable[[InputT], ValueT], default: InputT) -> None:
        self._convert = convert
        self._default: Any = default

    def __set_name__(self, owner: type, name: str) -> None:
        self._name = name

    def __get__(self, settings: object, owner: type) -> ValueT:
        # `dataclass` reads the default from the class, where there is no object.
        value: ValueT = self._default if settings is None else vars(settings)[self._name]
        return value

    def __set__(self, settings: object, value: InputT) -> None:
        vars(settings)[self._name] = self._convert(value)


def accept_fields(
    settings_class: Callable[Arguments, SettingsT], descriptions: Mapping[str, str]
) -> Callable[[Callable[[SettingsT], ReturnT]], Callable[Arguments, ReturnT]]:
    """Decorate a function of one settings object so that it takes the fields of the object as parameters.

    Args:
        settings_class: Dataclass of the settings; the annotation of a field may contain its description.
        descriptions: Name of a field -> its description, for fields without one in the annotation.

    Returns:
        A decorator; the signature and the docstring of its result list the fields.
    """

    def decorate(function: Callable[[SettingsT], ReturnT]) -> Callable[Arguments, ReturnT]:
        signature = inspect.signature(settings_class)

        def call_with_fields(*args: Arguments.args, **kwargs: Arguments.kwargs) -> ReturnT:
            """Call the function with settings from the fields; a wrong field is an error of the function."""
            # A wrong name is reported before any value is converted, which may read files.
            try:
                signature.bind(*args, **kwargs)
            except TypeError as error:
                raise TypeError(f"{function.__name__}: {error}") from None
            return function(settings_class(*args, **kwargs))

        update_wrapper(call_with_fields, function)
        parameters = []
        for parameter in signature.parameters.values():
            parameters.append(parameter.replace(annotation=_get_input_type(parameter.annotation)))
        return_type = inspect.signature(function).return_annotation
        call_with_fields.__signature__ = signature.replace(  # type: ignore[attr-defined]
            parameters=parameters, return_annotation=return_type
        )
        annotations = {parameter.name: parameter.annotation for parameter in parameters}
        call_with_fields.__annotations__ = {**annotations, "return": return_type}
        summary, heading, remainder = inspect.cleandoc(function.__doc__ or "").partition("\n\nReturns:")
        call_with_fields.__doc__ = f"{summary}\n\nArgs:\n{_format_args(signature, descriptions)}{heading}{remainder}"
        return call_with_fields

    return decorate


def _get_input_type(annotation: Any) -> Any:  # noqa: ANN401  (a type)
    """Return the type that a field accepts, without its description."""
    field_type = get_args(annotation)[0] if get_origin(annotation) is Annotated else annotation
    input_type = get_args(field_type)[0] if get_origin(field_type) is ConvertedField else field_type
    return getattr(input_type, "__forward_arg__", input_type)


def _format_args(signature: inspect.Signature, descriptions: Mapping[str, str]) -> str:
    """Format the section "Args:" of a docstring."""
    lines = []
    for name, parameter in signature.parameters.items():
        description = descriptions.get(name) or parameter.annotation.__metadata__[0]
        lines.append(textwrap.fill(f"{name}: {description}", 116, initial_indent=" " * 4, subsequent_indent=" " * 8))
    return "\n".join(lines)
