"""The messages of docs/external.md, both ways."""

import json
import socket
import struct
import threading

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as arrays

from steerbench_worker import DTYPES, Channel
from tests.common import refusal

VALUES = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats(allow_nan=False) | st.text(),
    lambda inner: st.lists(inner) | st.dictionaries(st.text(), inner),
    max_leaves=10,
)
NAMES = st.text().filter(lambda name: name not in {"message", "arrays", "self"})
ARRAYS = st.sampled_from(DTYPES).flatmap(
    lambda dtype: arrays.arrays(dtype, arrays.array_shapes(min_dims=1, min_side=0))
)


@pytest.fixture(scope="module")
def ends():
    """Two ends of a connection."""
    first, second = socket.socketpair()
    with first, second:
        yield Channel(first), Channel(second)


@given(st.text(), st.dictionaries(NAMES, VALUES), st.dictionaries(st.text(), ARRAYS))
def test_a_message_arrives_as_it_was_sent(ends, message, fields, sent):
    here, there = ends
    here.send(message, sent, **fields)
    header, arrived = there.receive()
    assert header == {"message": message, **fields}
    assert arrived.keys() == sent.keys()
    for name, array in sent.items():
        assert arrived[name].dtype == array.dtype
        np.testing.assert_array_equal(arrived[name], array)


def test_a_picture_larger_than_any_buffer_arrives_whole(ends):
    here, there = ends
    picture = np.random.default_rng(0).random((900, 1600, 3), dtype=np.float32)
    sender = threading.Thread(target=here.send, args=("render", {"rgb": picture}))
    sender.start()
    _, arrived = there.receive()
    sender.join()
    np.testing.assert_array_equal(arrived["rgb"], picture)


def test_the_bytes_are_those_of_the_document():
    first, second = socket.socketpair()
    with first, second:
        Channel(first).send("render", {"rgb": np.array([[1.0, 2.0]], ">f4")}, ns=5)
        sent = second.recv(1000)
    (length,) = struct.unpack("<I", sent[:4])
    header = {"message": "render", "ns": 5, "arrays": [["rgb", "float32", [1, 2]]]}
    assert json.loads(sent[4 : 4 + length]) == header
    assert sent[4 + length :] == struct.pack("<2f", 1.0, 2.0)


@given(st.binary(max_size=200), st.booleans())
def test_bytes_that_are_no_message_are_refused(content, framed):
    first, second = socket.socketpair()
    with second:
        with first:
            first.sendall(struct.pack("<I", len(content)) + content if framed else content)
        try:
            header, _ = Channel(second).receive()
        except (ValueError, EOFError):
            return
    assert isinstance(header["message"], str)


NO_ARRAYS = [
    "3",
    '{"rgb": 1}',
    '[["rgb"]]',
    '[["rgb", "uint8", [-1]]]',
    '[["rgb", "uint8", [true]]]',
    '[["rgb", "int32", [1]]]',
    '[["rgb", ["uint8"], [1]]]',
    '[["rgb", "uint8", [99999999999]]]',
]


@pytest.mark.parametrize("arrays", NO_ARRAYS)
def test_an_array_is_described_by_its_name_type_and_shape(ends, arrays):
    here, there = ends
    header = f'{{"message": "render", "arrays": {arrays}}}'.encode()
    here._connection.sendall(struct.pack("<I", len(header)) + header)
    with refusal("an array that the protocol does not have", ValueError):
        there.receive()
