"""What an interactive session shows of objects: short words, a small picture, their rows as a frame of data."""

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

WIDTH_PX = 760
CODE = re.compile(r"`([^`]+)`")


class _Brief(Repr):
    """Shapes of arrays, and the beginning of what is long."""

    def repr_Tensor(self, array: Any, level: int) -> str:  # noqa: ANN401  (a tensor, or an array of NumPy's)
        return f"{tuple(array.shape)} {str(array.dtype).removeprefix('torch.')}"

    repr_ndarray = repr_Tensor


def format_short_repr(instance: Any) -> str:  # noqa: ANN401  (any dataclass)
    """What a dataclass is made of in a few words; what is empty or None is left out. Meant as a `__repr__`.

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
    words = _Brief()
    named = ((field.name, getattr(instance, field.name)) for field in fields(instance))
    told = [f"{name}={words.repr(value)}" for name, value in named if value is not None and _is_some(value)]
    return f"{type(instance).__name__}({', '.join(told)})"


def _is_some(value: object) -> bool:
    return not isinstance(value, str | tuple | list | Mapping) or len(value) > 0


def escape_html(text: str) -> str:
    """Escape text for HTML and mark words between backticks as code.

    Example:
        >>> escape_html("more `--num-frames` <b>")
        'more <code>--num-frames</code> &lt;b&gt;'
    """
    return CODE.sub(r"<code>\1</code>", escape(text))


def escape_html_attribute(text: str) -> str:
    """Escape text for an HTML attribute or title, which holds no markup: backticks around words are dropped.

    Example:
        >>> escape_html_attribute('more `--num-frames` "now"')
        'more --num-frames &quot;now&quot;'
    """
    return CODE.sub(r"\1", escape(text))


def build_result_html(sentences: Iterable[str], figure: "Figure | None" = None) -> str:
    """What a notebook shows of a result, and no other file: sentences, the first as a heading, a picture below them.

    Example:
        >>> build_result_html(["<b>", "seen"])
        '<p><strong>&lt;b&gt;</strong></p><p>seen</p>'
    """
    first, *others = map(escape_control_chars, sentences)
    parts = [f"<strong>{escape_html(first)}</strong>", *map(escape_html, others)]
    if figure is not None:
        png = BytesIO()
        figure.savefig(png, format="png", dpi=WIDTH_PX / figure.get_size_inches()[0])
        source = f"data:image/png;base64,{b64encode(png.getvalue()).decode()}"
        parts.append(f'<img src="{source}" alt="{escape_html_attribute(first)}" style="max-width: 100%">')
    return "".join(f"<p>{part}</p>" for part in parts)


def build_xarray_dataset(
    maps: Mapping[str, "NDArray[Any]"], axes: Mapping[str, "NDArray[Any] | list[str]"]
) -> "xarray.Dataset":
    """Maps, by name, over the same axes, the outermost first, as a data set; ModuleNotFoundError without xarray."""
    return _extra("xarray").Dataset({name: (list(axes), values) for name, values in maps.items()}, coords=dict(axes))


def build_dataframe(rows: Iterable[Mapping[str, object] | Any]) -> "pandas.DataFrame":
    """Rows, mappings with the same keys or named tuples, as a frame of data; ModuleNotFoundError without pandas."""
    return _extra("pandas").DataFrame([row if isinstance(row, Mapping) else row._asdict() for row in rows])


def _extra(name: str) -> Any:  # noqa: ANN401  (a module)
    try:
        return import_module(name)
    except ModuleNotFoundError as error:
        raise ModuleNotFoundError(f"{name} is needed for this: pip install 'torchcover[frames]'") from error
