"""Links inside a dataset lead to somebody else's files."""

import shutil

import pytest
from episode_helpers import REPO_ID, new_dataset

from relmm.episodes import DurableDataset, upload_dataset, verify_and_repair
from relmm.errors import DatasetError

LINKS = (
    "images",
    "images/staging",
    "meta/relmm.json",
    "meta/episodes",
    "data/chunk-000",
    "data/chunk-000/extra.parquet",
)


def reopen(root) -> None:
    DurableDataset.open(root, REPO_ID).close()


def upload(root) -> None:
    upload_dataset(root, "me/life")


@pytest.mark.parametrize("use", [reopen, verify_and_repair, upload])
@pytest.mark.parametrize("name", LINKS)
def test_what_a_link_leads_to_is_neither_deleted_nor_changed_nor_uploaded(name, use, tmp_path) -> None:
    root, mine = tmp_path / "d", tmp_path / "mine"
    new_dataset(root, 2)
    link = root / name
    if link.suffix:
        mine.write_text("my private key")
        link.unlink(missing_ok=True)
    else:
        mine.mkdir()
        if link.exists():
            shutil.copytree(link, mine, dirs_exist_ok=True)
            shutil.rmtree(link)
        (mine / "thesis.txt").write_text("my thesis")
    link.parent.mkdir(exist_ok=True)
    link.symlink_to(mine)
    before = {path: path.read_bytes() for path in [mine, *mine.rglob("*")] if path.is_file()}
    with pytest.raises(DatasetError, match=f"{name} is a link to {mine}.*put a copy in its place"):
        use(root)
    assert {path: path.read_bytes() for path in [mine, *mine.rglob("*")] if path.is_file()} == before
    assert link.is_symlink()


def test_the_folder_itself_may_be_a_link(tmp_path) -> None:
    new_dataset(tmp_path / "disk", 2)
    (tmp_path / "d").symlink_to(tmp_path / "disk")
    reopen(tmp_path / "d")
    assert verify_and_repair(tmp_path / "d").episodes == 2
