"""The decode benchmark runs on input of its own making and says what it compares."""

from sprung.benchmarks.decode import run


def test_the_decode_benchmark_gives_two_figures() -> None:
    figures = list(run(seconds=2.0))
    assert [figure["name"] for figure in figures] == ["CAN decoding", "MCAP decoding"]
    for figure in figures:
        assert set(figure) == {"name", "value", "unit", "peer", "ratio", "target"}
        assert figure["value"] > 0
        assert figure["ratio"] > 0.5
