"""Tables 1 and 2 of the paper."""

import csv
from functools import lru_cache
from pathlib import Path
from typing import NamedTuple

TABLES = Path(__file__).with_name("tables.csv")
# One LiDAR: where it is mounted, and how many rows it has.
LIDARS = ("grille_128", "roof_128", "roof_64", "roof_32")
REGIONS = ("20m", "80m", "160m")
HEIGHTS = ("ground", "obstacle")
QUANTITIES = ("detection_percent", "radius_m")


class Place(NamedTuple):
    """What a number of the tables is about: one of each of the above."""

    quantity: str
    lidar: str
    region: str
    height: str


@lru_cache
def published():
    """Place -> number. Of the 60 there are 48: both tables have the LiDAR with 128 rows on the roof, and agree on it.

    Raises:
        ValueError: Two numbers for one place.
    """
    numbers = {}
    with TABLES.open(encoding="utf-8", newline="") as file:
        for row in csv.DictReader(file):
            place, value = Place(*(row[name] for name in Place._fields)), float(row["value"])
            if numbers.setdefault(place, value) != value:
                raise ValueError(f"{TABLES}: {value} and {numbers[place]} for {' '.join(place)}")
    return numbers
