"""Mix the streams of two real servers: equal bytes, ranks and loader workers at once, and a resume in the middle."""

from __future__ import annotations

from pathlib import Path

from torch.utils.data import DataLoader

from tests.clips import write_panned
from tests.stream.conftest import SMALL, SMALL_FLAGS, digest
from v2v_client import V2VStreamDataset
from v2v_client.local_server import LocalServer


def test_two_servers_two_ranks_two_loader_workers_and_a_resume(server: LocalServer, tmp_path: Path) -> None:
    write_panned(tmp_path, 4, 64, gop=16)

    def members(rank: int) -> list[V2VStreamDataset]:
        recipes = (SMALL, SMALL.replace(threshold=(0.1, 0.3), noise_sigma=(0.0, 0.0)))
        return [
            V2VStreamDataset(each.address, 2, recipe=recipe, seed=3, rank=rank, world_size=2)
            for each, recipe in zip((server, other), recipes, strict=True)
        ]

    def mixture(rank: int) -> V2VStreamDataset:
        return V2VStreamDataset.mix(dict(zip(members(rank), (0.7, 0.3), strict=True)), seed=4)

    with LocalServer(tmp_path, workers=1, flags=SMALL_FLAGS) as other:
        for rank in (0, 1):
            whole = list(DataLoader(mixture(rank), batch_size=None, num_workers=2))
            got = [digest(batch) for batch in whole]
            of_member = [batch.recipe.threshold[0] == 0.1 for batch in whole]
            assert (len(whole), sum(of_member)) == (9, 3)
            for member, is_other in zip(members(rank), (False, True), strict=True):
                alone = [digest(batch) for batch in member]
                own = [each for each, which in zip(got, of_member, strict=True) if which == is_other]
                assert own == alone[: len(own)]
            again = mixture(rank)
            again.load_state_dict(whole[4].resume_state)
            assert [digest(batch) for batch in again] == got[5:]
            assert again.epoch == 1
            assert whole[0].frame_grids.tolist() == [0, 1, 2, 3]
            assert whole[0].voxels.any()
