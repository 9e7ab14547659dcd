"""Display of results in interactive sessions: short representations, HTML with figures, data frames."""

import re
from base64 import b64encode
from collections.abc import Iterable, Mapping
from dataclasses import fields
from html import escape
from importlib import import_module
from io import BytesIO
from reprlib import Repr
from typing import TYPE_CHECKING, Any

from torchcover.files import escape_control_chars

if TYPE_CHECKING:
    import pandas
    import xarray
    from matplotlib.figure import Figure
    from numpy.typing import NDArray

CODE_PATTERN = re.compile(r"`([^`]+)`")


class _ShortRepr(Repr):
    """Representation with the shapes of arrays, and truncated long values."""

    def repr_Tensor(self, array: Any, level: int) -> str:  # noqa: ANN401  (a tensor or a NumPy array)
        return f"{tuple(array.shape)} {str(array.dtype).removeprefix('torch.')}"

    repr_ndarray = repr_Tensor


def format_short_repr(instance: Any) -> str:  # noqa: ANN401  (any dataclass)
    """Format a dataclass in a few words, without empty fields and None; for use as `__repr__`.

    Args:
        instance: Dataclass instance.

    Example:
        >>> import numpy as np
        >>> from dataclasses import dataclass
        >>> @dataclass(repr=False)
        ... class Cloud:
        ...     points: np.ndarray
        ...     name: str = ""
        ...     __repr__ = format_short_repr
        >>> Cloud(np.zeros((5000, 3)))
        Cloud(points=(5000, 3) float64)
    """
    short_repr = _ShortRepr()
    parts = []
    for field in fields(instance):
        value = getattr(instance, field.name)
        is_empty = isinstance(value, str | tuple | list | Mapping) and len(value) == 0
        if value is not None and not is_empty:
            parts.append(f"{field.name}={short_repr.repr(value)}")
    return f"{type(instance).__name__}({', '.join(parts)})"


def escape_html(text: str) -> str:
    """Escape text for HTML and mark words between backticks as code.

    Args:
        text: Plain text.

    Example:
        >>> escape_html("more `--num-frames` <b>")
        'more <code>--num-frames</code> &lt;b&gt;'
    """
    return CODE_PATTERN.sub(r"<code>\1</code>", escape(text))


def escape_html_attribute(text: str) -> str:
    """Escape text for an HTML attribute or title, without the backticks around words.

    Args:
        text: Plain text.

    Example:
        >>> escape_html_attribute('more `--num-frames` "now"')
        'more --num-frames &quot;now&quot;'
    """
    return CODE_PATTERN.sub(r"\1", escape(text))


def build_result_html(sentences: Iterable[str], figure: "Figure | None" = None) -> str:
    """Build HTML that displays a result in a notebook without further files.

    Args:
        sentences: Sentences, the first of which is the heading.
        figure: Figure below the sentences.

    Example:
        >>> build_result_html(["<b>", "seen"])
        '<p><strong>&lt;b&gt;</strong></p><p>seen</p>'
    """
    heading, *others = [escape_control_chars(sentence) for sentence in sentences]
    parts = [f"<strong>{escape_html(heading)}</strong>", *(escape_html(sentence) for sentence in others)]
    if figure is not None:
        png = BytesIO()
        width_px = 760  # width of an output cell
        figure.savefig(png, format="png", dpi=width_px / figure.get_size_inches()[0])
        source = f"data:image/png;base64,{b64encode(png.getvalue()).decode()}"
        parts.append(f'<img src="{source}" alt="{escape_html_attribute(heading)}" style="max-width: 100%">')
    return "".join(f"<p>{part}</p>" for part in parts)


def build_xarray_dataset(
    maps: Mapping[str, "NDArray[Any]"], axes: Mapping[str, "NDArray[Any] | list[str]"]
) -> "xarray.Dataset":
    """Build a data set of maps over common axes.

    Args:
        maps: Arrays by name.
        axes: Coordinates by name of the axis, the outermost first.

    Raises:
        ModuleNotFoundError: xarray is not installed.
    """
    return _import_extra("xarray").Dataset(
        {name: (list(axes), values) for name, values in maps.items()}, coords=dict(axes)
    )


def build_dataframe(rows: Iterable[Mapping[str, object] | Any]) -> "pandas.DataFrame":
    """Build a data frame.

    Args:
        rows: Mappings with equal keys, or named tuples.

    Raises:
        ModuleNotFoundError: pandas is not installed.
    """
    return _import_extra("pandas").DataFrame([row if isinstance(row, Mapping) else row._asdict() for row in rows])


def _import_extra(name: str) -> Any:  # noqa: ANN401  (a module)
    try:
        return import_module(name)
    except ModuleNotFoundError as error:
        raise ModuleNotFoundError(f"{name} is needed for this: pip install 'torchcover[frames]'") from error
