"""Names and sources of rigs: a rig is an object, a built-in name or a YAML file."""

from collections.abc import Sequence
from pathlib import Path

from torchcover.simulation import Rig, list_builtin_names

AnyRig = Rig | str | Path


def make_rig_names(rigs: Sequence[AnyRig]) -> list[str]:
    """Make the names of rigs in tables and files, numbered where two would be equal.

    Args:
        rigs: Rigs, names or paths.
    """
    return make_unique_names([_get_name(rig) for rig in rigs])


def make_unique_names(stems: Sequence[str]) -> list[str]:
    """Make names unique, also on file systems that ignore case, by numbers.

    Args:
        stems: Names.

    Example:
        >>> make_unique_names(["roof", "Roof", "grille"])
        ['roof', 'Roof_2', 'grille']
    """
    names: list[str] = []
    for stem in stems:
        used_names = {name.lower() for name in names}
        name, number = stem, 2
        while name.lower() in used_names:
            name, number = f"{stem}_{number}", number + 1
        names.append(name)
    return names


def load_rig(rig: AnyRig) -> Rig:
    """Load a rig.

    Args:
        rig: A rig, built-in name or YAML file.

    Raises:
        FileNotFoundError: Unknown file or built-in name.
        ValueError: The file is not a rig.
    """
    return rig if isinstance(rig, Rig) else Rig.load(rig)


def load_named_rig(rig: AnyRig) -> Rig:
    """Load a rig under the name that tables and files of every command have for it.

    Args:
        rig: A rig, built-in name or YAML file.

    Raises:
        FileNotFoundError: Unknown file or built-in name.
        ValueError: The file is not a rig.
    """
    return load_rig(rig).model_copy(update={"name": _get_name(rig)})


def is_rig_document(rig: AnyRig) -> bool:
    """Test whether a rig is more than a name of a recording: a `Rig`, a YAML file or a built-in name.

    Args:
        rig: A rig, name or path.
    """
    return isinstance(rig, Rig) or _is_file(rig) or str(rig) in list_builtin_names("rigs")


def format_rig_source(rig: AnyRig) -> str:
    """Format the name or path that the user gave for a rig.

    Args:
        rig: A rig, name or path.
    """
    return rig.name if isinstance(rig, Rig) else str(rig)


def _get_name(rig: AnyRig) -> str:
    """Return the name of a rig: its name in the file, or the built-in name."""
    return load_rig(rig).name if isinstance(rig, Rig) or _is_file(rig) else str(rig)


def _is_file(rig: str | Path) -> bool:
    """Test whether a rig is given as a YAML file."""
    return Path(rig).suffix in (".yaml", ".yml")
