"""Times of pictures in text: every unit, form and mistake."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from v2v_recordings.time_stamps import read_times

NS = {"s": 10**9, "ms": 10**6, "us": 10**3, "ns": 1}
COUNT = 5


def text(times: list[object], form: str = "{t}", heading: str = "") -> bytes:
    return (heading + "".join(f"{form.format(t=t, i=i)}\n" for i, t in enumerate(times))).encode()


@pytest.mark.parametrize("first", [0, 4132468, 1403636579763555584])
@pytest.mark.parametrize(
    ("step", "unit"),
    [
        (1, "s"), (2, "s"), (33, "ms"), (40, "ms"), (100, "ms"), (200, "ms"), (1000, "us"), (2000, "us"),
        (35714, "us"), (50001, "us"), (100000, "us"), (16666667, "ns"), (50000000, "ns"), (1000000000, "ns"),
    ],
)  # fmt: skip
def test_the_unit_of_whole_numbers_follows_from_the_rate(first: int, step: int, unit: str) -> None:
    first = first if first < 2**61 // NS[unit] else 7
    times = [first + step * at for at in range(COUNT)]
    ns, names, remark = read_times(text(list(times)))
    assert ns.tolist() == [time * NS[unit] for time in times], "exact"
    assert not len(names)
    if step == 1:
        assert remark.startswith(
            f"its numbers, {first}, {first + 1} ..., count the pictures one by one and are taken for"
        )
        assert "remove the file and state the rate with --rate" in remark
        assert read_times(text(list(times), heading="# seconds\n"))[2] == ""
    else:
        guessed = f"its times are taken for {unit}, {1e9 / step / NS[unit]:.4g} pictures a second"
        assert remark == ("" if unit == "s" else guessed)


@pytest.mark.parametrize(("step", "unit"), [(0.04, "s"), (1.0, "s"), (33.366, "ms"), (35714.28, "us"), (1e-4, "s")])
def test_the_unit_of_fractions_follows_from_the_rate(step: float, unit: str) -> None:
    ns, _, remark = read_times(text([f"{100.5 + step * at:.6f}" for at in range(COUNT)]))
    np.testing.assert_allclose(np.diff(ns), step * NS[unit], rtol=1e-4)
    assert bool(remark) == (unit != "s")


@pytest.mark.parametrize("step", [250, 600, 250000])
def test_two_plausible_units_are_refused_and_a_heading_decides(step: int) -> None:
    one, other = ("ms", "us") if step < 1000 else ("us", "ns")
    times: list[object] = [at * step for at in range(COUNT)]
    with pytest.raises(ValueError, match=f"may be in {one}, .* or {other}, .*: state the unit in a first line"):
        read_times(text(times))
    for unit in (one, other):
        ns, _, remark = read_times(text(times, heading=f"# time_{unit}\n"))
        assert (ns[1], remark) == (step * NS[unit], "")


@pytest.mark.parametrize(
    ("heading", "unit"),
    [
        ("# seconds\n", "s"), ("time (s)\n", "s"), ("# in s\n", "s"),
        ("timestamp_ms\n", "ms"), ("# milliseconds\n", "ms"),
        ("frame,t [us]\n", "us"), ("# exposure_start_timestamp_us\n", "us"), ("# Microseconds\n", "us"),
        ("camera left\n\ntime in \u00b5s\n", "us"), ("#timestamp [ns],filename\n", "ns"), ("\ufeff# time_ns\n", "ns"),
    ],
)  # fmt: skip
def test_a_heading_states_the_unit_even_of_a_rate_that_no_camera_has(heading: str, unit: str) -> None:
    ns, _, remark = read_times(text([0, 10, 20], heading=heading))
    assert (ns.tolist(), remark) == ([0, 10 * NS[unit], 20 * NS[unit]], "")


@pytest.mark.parametrize(
    "heading", ["# contact us\n", "frame's times\n", "# ms or microseconds\n", "name value\n", "\ufeff"]
)
def test_other_headings_state_no_unit(heading: str) -> None:
    assert read_times(text([0.5, 0.54, 0.58], heading=heading))[0].tolist() == [500000000, 540000000, 580000000]


@pytest.mark.parametrize("heading", ["", "\ufeff", "# a comment\n\n", "the times\nof pictures\n"])
@pytest.mark.parametrize("end", ["", "Z", "+02:00", " +0200"])
@pytest.mark.parametrize("form", ["{t}", "{i} {t}", "{t}\tframe_{i:04}.png", "{i};{t};a/{i:04}.jpg", '"{t}",{i}'])
def test_dates_are_exact(heading: str, end: str, form: str) -> None:
    times = [f"2011-09-26{'T '[len(end) % 2]}13:02:2{at}.59436037{at}{end}" for at in range(COUNT)]
    ns, names, remark = read_times(text(list(times), form, heading))
    assert np.diff(ns).tolist() == [10**9 + 1] * (COUNT - 1)
    assert ns[0] % 10**9 == 594360370
    assert (len(names), remark) == (COUNT if "g" in form else 0, "")


@pytest.mark.parametrize(
    ("form", "name"),
    [
        ("{t}", ""), ("{t} {i}", ""), ("{i} {t}", ""), ("{i},{t}", ""), ("{t},a.png", "a.png"),
        ("b/a.png\t{t}", "b/a.png"),
        ("{i}; {t}; a.png", "a.png"), ("{t} # of the first", ""), ('"{t}";"a.png"', "a.png"), ("  {t}  \r", ""),
    ],
)  # fmt: skip
def test_the_columns_tell_the_time(form: str, name: str) -> None:
    ns, names, _ = read_times(text([0.04, 0.08, 0.13], form))
    assert ns.tolist() == [40000000, 80000000, 130000000]
    assert list(names) == [name] * 3 * bool(name)


@pytest.mark.parametrize(
    ("lines", "why"),
    [
        ("0\n0.1\n0.1\n", "do not increase: 0.1 in line 3 does not come after 0.1 in line 2"),
        ("3\n\n2\n1\n", "do not increase: 2 in line 3 does not come after 3 in line 1"),
        ("0\nnan\n1\n", "line 2: 'nan': a line is a time in seconds or a date"),
        ("0\n1 a.png\n2\n", "line 2: '1 a.png': a line is"),
        ("0.1 0.2 0.3\n", "line 1: '0.1 0.2 0.3': a line is"),
        ("0,04\n0,08\n", "line 1: two columns of numbers, and none counts"),
        ("10 400\n10 900\n", "line 1: two columns of numbers, and none counts"),
        ("40\n0 0.0\n1 0.1\n", "line 1: '40': a line is"),
        ("", "states no time"),
        ("13:02:25.5\n13:02:25.6\n", "states no time"),
        ("2011-13-26 13:02:25\n", "2011-13-26"),
        ("0\n1e30\n", "beyond 4e9 s"),
    ],
)
def test_other_lines_are_refused_with_what_belongs_there(lines: str, why: str) -> None:
    with pytest.raises(ValueError, match=why):
        read_times(lines.encode())


@given(st.binary(max_size=60) | st.text("0123456789.,-eE# \tTZ:ansu\n", max_size=60).map(str.encode))
def test_any_bytes_give_increasing_times_or_a_refusal(data: bytes) -> None:
    try:
        ns, names, _ = read_times(data)
    except ValueError:
        return
    assert len(ns)
    assert len(names) in (0, len(ns))
    assert (ns[1:] > ns[:-1]).all()
