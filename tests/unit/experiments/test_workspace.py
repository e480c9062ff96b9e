"""Folders of the data of a scale."""

from zerobev.experiments.workspace import Workspace


def test_kinds_of_homes_share_no_folder(tmp_path):
    flats = Workspace("smoke", root=tmp_path)
    varied = Workspace("smoke", root=tmp_path, settings=["scenes.homes=varied"])
    assert flats.split.train[0].parents[1] == tmp_path / ".cache" / "homes-2-0"  # as always
    assert varied.split.train[0].parents[1] == tmp_path / ".cache" / "homes-varied-2-0"
    assert varied.views_folder != flats.views_folder
    assert Workspace("smoke", root=tmp_path, settings=["scenes.homes=flats"]).views_folder == flats.views_folder
