"""Tests of the choice of device, precision and threads for training."""

from __future__ import annotations

import pytest
import torch

from spn_data.errors import InputError
from spn_model.training.machine import choose, cores, limited_threads


@pytest.mark.parametrize("device", ["tpu", "cuda:x", "mps", "meta", ""])
def test_what_is_no_device_is_refused(device):
    """An unknown device is rejected with a list of valid ones."""
    with pytest.raises(InputError, match=f"unknown device '{device}'; choose auto, cpu, cuda"):
        choose(device, 1, "auto")


@pytest.mark.skipif(torch.cuda.is_available(), reason="there is a graphics card")
def test_a_graphics_card_that_is_not_there_is_refused():
    """An unavailable `cuda` is rejected instead of replaced; `auto` falls back to the CPU."""
    with pytest.raises(InputError, match="not found, or torch was built without CUDA"):
        choose("cuda", 1, "auto")
    assert choose("auto", 1, "auto").device.type == "cpu"


@pytest.mark.parametrize(
    ("threads", "computing", "making"), [(1, 1, 1), (2, 1, 1), (4, 3, 1), (8, 6, 2), (64, 56, 8)]
)
def test_makers_of_batches_have_their_own_threads(threads, computing, making):
    """Threads are divided between training and batch workers, unless there is only one."""
    machine = choose("cpu", threads, "float32", makes_batches=True)
    assert (machine.threads, machine.workers) == (computing, making)
    assert choose("cpu", threads, "float32").threads == threads
    assert choose("cpu", 0, "float32").threads == cores()


def test_precision_is_taken_as_it_is_given():
    """bfloat16 is used if requested, even if it is slow on this processor."""
    assert choose("cpu", 1, "bfloat16").bfloat16
    assert not choose("cpu", 1, "float32").bfloat16
    assert choose("cpu", 1, "bfloat16").plain()["precision"] == "bfloat16"


def test_libraries_are_left_as_they_were():
    """The number of torch threads is limited inside the context and restored after an error."""
    before = torch.get_num_threads()

    def fail() -> None:
        with limited_threads(choose("cpu", 3, "float32")):
            assert torch.get_num_threads() == 3
            raise KeyError

    with pytest.raises(KeyError):
        fail()
    assert torch.get_num_threads() == before
