"""What rigs are called in tables and files."""

from collections.abc import Sequence
from pathlib import Path

from torchcover.simulation import Rig, builtin_names

AnyRig = Rig | str | Path


def distinct_names(rigs: Sequence[AnyRig]) -> list[str]:
    """What the columns are called: the rig's name, or the stem of its file; numbered where two would be the same.

    Example:
        >>> distinct_names(["kitti", "old/my.yaml", "new/my.yaml"])
        ['kitti', 'my', 'my_2']
    """
    return distinct([_stem(rig) for rig in rigs])


def distinct(stems: Sequence[str]) -> list[str]:
    """Names of which no two are the same, for no file system; numbered where they would be.

    Example:
        >>> distinct(["roof", "Roof", "grille"])
        ['roof', 'Roof_2', 'grille']
    """
    names: list[str] = []
    for stem in stems:
        name, number = stem, 2
        while name.lower() in (other.lower() for other in names):
            name, number = f"{stem}_{number}", number + 1
        names.append(name)
    return names


def loaded(rig: AnyRig) -> Rig:
    """The rig itself.

    Raises:
        FileNotFoundError: No such file or built-in name.
        ValueError: The file is not a rig.
    """
    return rig if isinstance(rig, Rig) else Rig.load(rig)


def as_called(rig: AnyRig) -> Rig:
    """The rig itself, under the name that tables and files of every command have for it.

    Raises:
        FileNotFoundError: As `loaded`.
        ValueError: As `loaded`.
    """
    return loaded(rig).model_copy(update={"name": _stem(rig)})


def is_document(rig: AnyRig) -> bool:
    """Whether there is more to it than a name: a rig, the path of one, or the name of a built-in one."""
    return isinstance(rig, Rig) or _is_file(rig) or str(rig) in builtin_names("rigs")


def given_as(rig: AnyRig) -> str:
    """What the user called it."""
    return rig.name if isinstance(rig, Rig) else str(rig)


def _stem(rig: AnyRig) -> str:
    if isinstance(rig, Rig):
        return rig.name
    return Path(rig).stem if _is_file(rig) else str(rig)


def _is_file(rig: str | Path) -> bool:
    return Path(rig).suffix in (".yaml", ".yml")
