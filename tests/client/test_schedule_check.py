import pytest

from v2v_client.loadtest import ScheduleCheck


def epochs(*wanted, sequences=11, batch=2):
    return [(epoch, [at, at + 1]) for epoch in wanted for at in range(0, sequences - sequences % batch, batch)]


def checked(batches, first_epoch=3):
    check = ScheduleCheck(sequences=11, batch_size=2, first_epoch=first_epoch)
    for epoch, indices in batches:
        check.observe(epoch, indices)
    return check


def counts(check):
    return check.lost, check.duplicated, check.foreign, check.out_of_order


def test_a_correct_run_over_epochs_has_no_faults():
    check = checked(epochs(3, 4)[:-2])
    assert counts(check) == (0, 0, 0, 0)
    assert check.faultless


PLANTED = {
    "a batch lost": (epochs(3)[:2] + epochs(3)[3:], (2, 0, 0, 1)),
    "a sample lost at the end of an epoch": ([*epochs(3)[:-1], (3, [8]), *epochs(4)], (1, 0, 0, 1)),
    "an epoch lost": (epochs(3) + epochs(5), (10, 0, 0, 1)),
    "the first batch lost": (epochs(3)[1:], (2, 0, 0, 1)),
    "a batch twice": ([*epochs(3), epochs(3)[-1]], (0, 2, 0, 1)),
    "a sample twice within a batch": ([(3, [0, 0])], (0, 1, 0, 1)),
    "an epoch twice": (epochs(3, 3), (0, 10, 0, 1)),
    "two batches exchanged": ([epochs(3)[1], epochs(3)[0], *epochs(3)[2:]], (0, 0, 0, 3)),
    "a sample of the dropped rest": ([*epochs(3), (3, [10])], (0, 0, 1, 0)),
    "a sample of an earlier epoch": ([(2, [0]), *epochs(3)], (0, 0, 1, 0)),
}


@pytest.mark.parametrize(("batches", "found"), PLANTED.values(), ids=PLANTED.keys())
def test_planted_faults_are_counted(batches, found):
    check = checked(batches)
    assert counts(check) == found
    assert not check.faultless
