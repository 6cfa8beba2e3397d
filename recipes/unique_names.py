"""Names for what is written about each of several files."""

from __future__ import annotations

import itertools
from collections import Counter
from collections.abc import Sequence
from pathlib import Path


def unique_names(paths: Sequence[str]) -> list[str]:
    """File stems, made longer by their folders where two are alike, and by a number where these are alike too."""
    stems = [Path(path).stem for path in paths]
    alike, names = Counter(stems), list[str]()
    for path, stem in zip(paths, stems, strict=True):
        whole = Path(path).with_suffix("").as_posix().strip("/").replace("/", "-")
        name = stem if alike[stem] == 1 else whole
        further = (f"{name}-{number}" for number in itertools.count(2))
        names.append(next(free for free in itertools.chain([name], further) if free not in names))
    return names
