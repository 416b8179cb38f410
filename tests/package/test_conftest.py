"""The suite's own promises: no network, and the same draws in every test."""

from __future__ import annotations

import socket
import threading

import pytest
import torch

# An address that is set aside for documentation (RFC 5737); nothing is there, and nothing is sent.
OTHER_MACHINE = ("192.0.2.1", 9)


def test_no_test_reaches_another_machine():
    with socket.socket() as plain, pytest.raises(RuntimeError, match="without a network"):
        plain.connect(OTHER_MACHINE)
    with socket.socket() as plain, pytest.raises(RuntimeError, match="without a network"):
        plain.connect_ex(OTHER_MACHINE)
    with pytest.raises(RuntimeError, match="lidar2pano.invalid"):
        socket.create_connection(("lidar2pano.invalid", 443))


def test_this_machine_stays_reachable():
    with socket.create_server(("127.0.0.1", 0)) as server:

        def answer() -> None:
            server.accept()[0].close()

        answering = threading.Thread(target=answer, daemon=True)
        answering.start()
        socket.create_connection(server.getsockname()).close()
        answering.join(timeout=10)
        assert not answering.is_alive()


@pytest.mark.parametrize("turn", [1, 2])
def test_every_test_draws_the_same_numbers(turn):
    assert torch.rand(()).item() == torch.rand((), generator=torch.Generator().manual_seed(0)).item()
