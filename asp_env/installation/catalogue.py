"""Public recordings of traffic: content, licence, where they are had, and which reader reads them.

The facts are those of the publishers' pages and papers. Licences may change: the publisher's page
decides.
"""

from dataclasses import dataclass
from typing import Literal

Tested = Literal["published files", "documented layout", "no reader"]
"""What the reader of a data set is tested on: files as they are published, files that tests write
by the publisher's description, or nothing, since there is no reader."""


@dataclass(frozen=True, slots=True, kw_only=True)
class PublicDataset:
    """A public data set, available at least for research."""

    name: str
    """Its name in commands, also that of the suggested folder."""
    title: str
    holds: str
    """Places, road users, frame rate, and what lies beside the tracks."""
    licence: str
    access: Literal["application", "download"]
    """Whether the publisher asks for an application first."""
    obtain: str
    """Where it is had, and how."""
    place: str
    """What to put into the folder."""
    reader: str | None
    """Name of the reader; None if a reader of one's own is needed."""
    tested: Tested
    notes: str = ""

    @property
    def folder(self) -> str:
        """The suggested folder; any other works as well."""
        return f"data/{self.name}"

    @property
    def check(self) -> str:
        """The command that reads all recordings in the folder."""
        return f"asp-env doctor {self.folder}"


_LEVELX = "on application, free of charge for non-commercial use"
_LEVELX_OBTAIN = "https://levelxdata.com; the answer has a link to an archive"
_LEVELX_PLACE = "the unpacked archive: XX_tracks.csv, XX_tracksMeta.csv, XX_recordingMeta.csv"
_OWN_READER = "write a reader of your own, docs/readers.md shows one of 60 lines"

DATASETS: tuple[PublicDataset, ...] = (
    PublicDataset(
        name="inD",
        title="inD",
        holds="4 German intersections, 33 recordings at 25 Hz, all road users; lanelet2 maps",
        licence=_LEVELX,
        access="application",
        obtain=_LEVELX_OBTAIN,
        place=f"{_LEVELX_PLACE}, XX_background.png and the folder of .osm maps, at any depth",
        reader="levelx",
        tested="documented layout",
    ),
    PublicDataset(
        name="rounD",
        title="rounD",
        holds="3 German roundabouts, 24 recordings at 25 Hz, all road users; lanelet2 maps",
        licence=_LEVELX,
        access="application",
        obtain=_LEVELX_OBTAIN,
        place=f"{_LEVELX_PLACE}, XX_background.png and the folder of .osm maps, at any depth",
        reader="levelx",
        tested="documented layout",
    ),
    PublicDataset(
        name="uniD",
        title="uniD",
        holds="a street on a German campus at 25 Hz, mostly pedestrians and bicycles",
        licence=_LEVELX,
        access="application",
        obtain=_LEVELX_OBTAIN,
        place=f"{_LEVELX_PLACE}, and the lanelet2 map (.osm)",
        reader="levelx",
        tested="documented layout",
        notes="a recording without a lanelet2 map is an error",
    ),
    PublicDataset(
        name="exiD",
        title="exiD",
        holds="entries and exits of German motorways at 25 Hz, vehicles; lanelet2 maps",
        licence=_LEVELX,
        access="application",
        obtain=_LEVELX_OBTAIN,
        place=f"{_LEVELX_PLACE}, and the lanelet2 maps (.osm)",
        reader="levelx",
        tested="documented layout",
        notes="planners and rules are made for intersections; highD has another layout, without a "
        "reader",
    ),
    PublicDataset(
        name="INTERACTION",
        title="INTERACTION 1.0 to 1.2",
        holds="intersections, roundabouts and merging in several countries at 10 Hz; lanelet2 maps",
        licence="on application, non-commercial",
        access="application",
        obtain="https://interaction-dataset.com",
        place="recorded_trackfiles/LOCATION/vehicle_tracks_NNN.csv, or train/LOCATION_train.csv "
        "of 1.2, beside maps/LOCATION.osm",
        reader="interaction, interaction-cases",
        tested="documented layout",
        notes="a case of 1.2 lasts 4 s, which is too short for scenarios of the default length",
    ),
    PublicDataset(
        name="SinD",
        title="SinD",
        holds="signalised intersections in China at 9.99 Hz, all road users, traffic lights; "
        "lanelet2 maps",
        licence="non-commercial; four sample recordings are public",
        access="download",
        obtain="https://github.com/SOTIF-AVLab/SinD; the complete data on application there",
        place="LOCATION/NAME/Veh_smoothed_tracks.csv, Ped_smoothed_tracks.csv and the lights' "
        "table, with the .osm map there or above",
        reader="sind",
        tested="documented layout",
        notes="stop lines of the lights are not published: docs/data.md shows how to add them",
    ),
    PublicDataset(
        name="openDD",
        title="openDD",
        holds="7 German roundabouts, about 84,000 tracks",
        licence="CC BY-ND (earlier releases: CC BY)",
        access="download",
        obtain="https://l3pilot.eu",
        place=_OWN_READER,
        reader=None,
        tested="no reader",
    ),
    PublicDataset(
        name="Songdo",
        title="Songdo Traffic (geo-trax)",
        holds="20 intersections of Songdo, Korea, about 700,000 tracks of vehicles at 29.97 Hz",
        licence="CC BY 4.0",
        access="download",
        obtain="Zenodo record 17924857 (https://doi.org/10.5281/zenodo.17924857)",
        place="the unpacked .csv tables, at any depth",
        reader="geo-trax",
        tested="published files",
        notes="tested on geo-trax's own sample of 5 s; no map: the drivable area is what vehicles "
        "cover, and there are no lanes",
    ),
    PublicDataset(
        name="Automatum",
        title="Automatum Data",
        holds="Bavarian roundabouts and T-crossings; OpenDRIVE maps",
        licence="CC BY-ND 4.0",
        access="download",
        obtain="https://huggingface.co/AutomatumData",
        place=_OWN_READER,
        reader=None,
        tested="no reader",
        notes="OpenDRIVE maps are not read",
    ),
    PublicDataset(
        name="DLR-UT",
        title="DLR Urban Traffic (DLR UT)",
        holds="12 h of the inner ring of Brunswick: vehicles, VRUs, traffic lights",
        licence="CC BY 4.0",
        access="download",
        obtain="Zenodo record 15754836 (https://doi.org/10.5281/zenodo.15754836)",
        place=_OWN_READER,
        reader=None,
        tested="no reader",
    ),
    PublicDataset(
        name="TAF-BW",
        title="TAF-BW (test area autonomous driving Baden-Württemberg)",
        holds="two signalised intersections of Karlsruhe at 10 Hz, all road users; lanelet2 maps",
        licence="CC BY-NC-SA 4.0",
        access="download",
        obtain="the repositories of FZI on GitHub",
        place="LOCATION/vehicle_tracks_NNN.csv, pedestrian_tracks_NNN.csv and meta_data.csv, "
        "beside maps/LOCATION.osm",
        reader="interaction",
        tested="published files",
        notes="velocities and headings have faults; states are derived from positions",
    ),
)
"""The data sets, those with the most users first."""
