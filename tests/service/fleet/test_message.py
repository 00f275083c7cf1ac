"""Messages of estimates: exact ones bit by bit, small ones within what they promise, damaged ones refused in a line."""

from __future__ import annotations

import zlib

import msgpack
import numpy as np
import pytest

from sprung.model.signals import Deviating, Estimate, FloatArray, MeasurementFault
from sprung.service.fleet.coding import from_log_steps, log_steps, pack_ints, unpack_ints
from sprung.service.fleet.message import Message, UnreadableMessage, WindowEstimate, decode, encode

P, S, H = 24, 12, 57
START = 1_790_000_000_000_000_000


def spd(rng: np.random.Generator, size: int, condition: float) -> FloatArray:
    """A random covariance whose correlation matrix has about this condition."""
    q, _ = np.linalg.qr(rng.normal(size=(size, size)))
    found = (q * np.geomspace(1, 1 / condition, size)) @ q.T
    wide = np.geomspace(1e-3, 1e-2, size)
    return found / np.sqrt(np.outer(np.diag(found), np.diag(found))) * np.outer(wide, wide)


def estimate(rng: np.random.Generator, condition: float = 1e3, deviating: bool = True) -> Estimate:
    found = Deviating(
        np.zeros(H), spd(rng, P, condition), rng.normal(size=(P, H)), spd(rng, H, condition), rng.normal(size=H), 1188.0
    )
    sensors = rng.uniform(0.01, 0.1, S)
    sensors[3] = np.nan
    return Estimate(
        0.1 * rng.normal(size=P),
        spd(rng, P, condition),
        rng.uniform(size=P) > 0.1,
        0.031,
        sensors,
        1.07,
        True,
        True,
        3,
        deviating=found if deviating else None,
        faults=(MeasurementFault("car_1l", "frozen", 0.25, 0.0),),
        noise=0.012,
    )


def message(count: int, condition: float = 1e3) -> Message:
    rng = np.random.default_rng(7)
    windows = [
        WindowEstimate(START + i * 500_000_000, "used", None, 0, i == 0, estimate(rng, condition, i % 4 == 0))
        for i in range(count)
    ]
    windows.insert(2, WindowEstimate(START + 750_000_000, "dropped", "12 samples lost", 0, False, None))
    return Message("north-0017", "digest", tuple(windows))


def test_exact_messages_come_back_bit_by_bit() -> None:
    sent = message(9)
    got = decode(encode(sent, "exact"))
    assert (got.vehicle, got.model, len(got.windows)) == ("north-0017", "digest", 10)
    for one, other in zip(sent.windows, got.windows, strict=True):
        assert (one.start, one.outcome, one.reason, one.new_segment) == (
            other.start,
            other.outcome,
            other.reason,
            other.new_segment,
        )
        if one.estimate is None:
            assert other.estimate is None
            continue
        assert other.estimate is not None
        for name in Estimate.__slots__:
            if name not in ("deviating", "states"):
                np.testing.assert_array_equal(getattr(one.estimate, name), getattr(other.estimate, name))
        if one.estimate.deviating is not None:
            for name in Deviating.__slots__:
                np.testing.assert_array_equal(
                    getattr(one.estimate.deviating, name), getattr(other.estimate.deviating, name)
                )


@pytest.mark.parametrize(("condition", "factor"), [(1.0, 1.5), (1e2, 2.0), (1e4, 5.0)])
def test_small_messages_keep_every_direction_of_the_covariance(condition: float, factor: float) -> None:
    """However correlated the parameters are, no direction becomes much surer or less sure than it was.

    Windows of a running train have correlation matrices of condition 10 to 100.
    """
    sent = message(6, condition)
    got = decode(encode(sent, "small"))
    for one, other in zip(sent.windows, got.windows, strict=True):
        if one.estimate is None or other.estimate is None:
            continue
        std = np.sqrt(np.diag(one.estimate.covariance))
        assert np.abs((one.estimate.log_ratio - other.estimate.log_ratio) / std).max() < 0.033
        np.testing.assert_allclose(np.sqrt(np.diag(other.estimate.covariance)), std, rtol=0.016)
        ratio = np.linalg.eigvals(np.linalg.solve(one.estimate.covariance, other.estimate.covariance)).real
        assert ratio.min() > 1 / factor and ratio.max() < factor
        np.testing.assert_allclose(one.estimate.per_sensor, other.estimate.per_sensor, rtol=0.01)
        np.testing.assert_array_equal(one.estimate.identifiable, other.estimate.identifiable)
        if one.estimate.deviating is not None and other.estimate.deviating is not None:
            a, b = one.estimate.deviating, other.estimate.deviating
            assert np.linalg.eigvalsh(b.information).min() > 0
            wide, sure = np.sqrt(np.diag(a.given)), np.sqrt(np.diag(a.information))
            assert np.abs((a.score - b.score) / sure).max() < 0.02 * np.abs(a.score / sure).max() + 0.01
            unit = wide[:, None] * sure[None, :]
            assert np.abs((a.cross - b.cross) / unit).max() < 0.02 * np.abs(a.cross / unit).max() + 0.01


def test_a_small_message_is_small() -> None:
    sent = Message("a", "d", tuple(w for w in message(60).windows if w.estimate is None or not w.estimate.deviating))
    assert len(encode(sent, "small")) < 400 * len(sent.windows) < len(encode(sent, "exact")) / 5


def test_whole_numbers_of_any_size_come_back() -> None:
    values = np.array([[0, -1, 2**62], [2**62, -(2**61), 5]])
    np.testing.assert_array_equal(unpack_ints(pack_ints(values)), values)
    np.testing.assert_array_equal(unpack_ints(pack_ints(values[:0])), values[:0])


def test_scales_keep_zero_and_what_is_missing() -> None:
    given = np.array([0.0, np.nan, 1e-30, 3.7e4])
    np.testing.assert_allclose(from_log_steps(log_steps(given)), given, rtol=0.008)


@pytest.mark.parametrize(
    "data",
    [
        b"",
        b"not compressed",
        zlib.compress(b"\xc1"),
        zlib.compress(msgpack.packb({"format": 2})),
        zlib.compress(msgpack.packb([1, 2])),
        encode(message(3), "exact")[:-9],
        zlib.compress(bytes(60_000_000), 9),
    ],
)
def test_what_is_no_message_is_refused_in_one_line(data: bytes) -> None:
    with pytest.raises(UnreadableMessage) as caught:
        decode(data)
    assert "\n" not in str(caught.value)


def test_damaged_contents_never_do_anything_but_be_refused_or_read() -> None:
    """Bytes of the contents changed at random, the compression intact."""
    plain = bytearray(zlib.decompress(encode(message(3), "small")))
    rng = np.random.default_rng(1)
    for _ in range(300):
        changed = bytearray(plain)
        for at in rng.integers(0, len(plain), 3):
            changed[at] = int(rng.integers(0, 256))
        try:
            decode(zlib.compress(bytes(changed), 1))
        except UnreadableMessage as error:
            assert "\n" not in str(error)
