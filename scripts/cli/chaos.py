"""`headway chaos`: a bad wire between a controller and its devices."""

from __future__ import annotations

import sys
from contextlib import ExitStack
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from cyclopts import Parameter

from headway.cli.claim import PLANT, claimed
from headway.cli.failure import ExitCode, Failure
from headway.cli.linked import Factor, Kind, check_factor, place_folder
from headway.cli.plant import outlet_at, stop_at_eof
from headway.cli.stopping import signals_stop
from headway.cli.wall import WallClock

if TYPE_CHECKING:
    from headway.configs.schema import Channel

LARGEST_S = 3600.0


def chaos(
    devices: Path,
    ports: Path,
    /,
    *,
    link: Kind = "serial",
    channel: Annotated[
        list[str] | None,
        Parameter(name="--set", metavar="KEY=VALUE", negative_iterable=()),
    ] = None,
    corrupt: float = 0.0,
    partition_every: float = 0.0,
    partition_for: float = 0.1,
    seed: int = 0,
    realtime_factor: Factor = 1.0,
    until_eof: Annotated[bool, Parameter(negative=())] = False,
) -> int:
    """Stands between a controller and its devices and spoils what passes, by seed.

    Offers each port that it finds in one folder under the same name in another. In both directions
    packets are delayed, lost, doubled and overtaken as a channel of the simulated network has it,
    and their bits flipped; and at times nothing passes at all. Ctrl-C ends it, which to both sides
    is a pulled cable.

    Example: a controller that loses a packet in ten, and the wire twice a minute.

        headway plant configs/arm2.yaml --ports good --set sync.limit_us=2000
        headway chaos good bad --set loss=0.1 --partition-every 30
        headway run configs/arm2.yaml --link serial --ports bad --set sync.limit_us=2000

    Parameters
    ----------
    devices
        The folder with the devices' ports, as of `headway plant --ports`.
    ports
        The folder to offer them in.
    link
        What they are.
    channel
        One key of what a channel does, as in sim.to_device: delay_us, jitter_us, tail, tail_us,
        loss, loss_run, reorder, reorder_us, duplicate, in_order, bandwidth_bit_per_s. May be
        repeated. All are 0 by default.
    corrupt
        The share of packets in which a bit is flipped.
    partition_every
        Seconds between times in which nothing passes, on average; 0: there are none.
    partition_for
        Seconds that each of them lasts.
    seed
        Of everything random.
    realtime_factor
        As of the plant and the controller.
    until_eof
        Ends when standard input does.
    """
    check_factor(realtime_factor)
    if not 0 <= corrupt <= 1:
        raise Failure(ExitCode.USAGE, f"--corrupt {corrupt:g}: give a share, 0 to 1")
    for name, value in (("every", partition_every), ("for", partition_for)):
        if not 0 <= value <= LARGEST_S:
            raise Failure(ExitCode.USAGE, f"--partition-{name} {value:g}: give seconds, up to 3600")
    made = _channel(channel or [])
    import numpy as np

    from headway.configs.schema import Links
    from headway.devices.places import open_places
    from headway.devices.port import PortError
    from headway.sim.chaos import Chaos, Trouble

    folder = place_folder(ports)
    if devices.resolve() == folder.resolve():
        raise Failure(ExitCode.USAGE, f"{ports}: the ports offered need a folder of their own")
    with ExitStack() as stack:
        found, failed = open_places(devices, Links(serial=[]), link == "udp")
        for port in found:
            stack.callback(port.close)
        if not found or failed:
            said = "; ".join(failed) or f"{devices}: there is no {link} port"
            raise Failure(ExitCode.DEVICE, said)
        places = sorted(
            p.name
            for p in devices.iterdir()
            if (p.suffix == ".udp") == (link == "udp") and not p.name.startswith(".")
        )
        outlets = []
        for place in places:
            machine, _, device = place.removesuffix(".udp").partition("-")
            outlets.append(stack.enter_context(outlet_at(link, folder, machine, device)))
            print(f"{place}: {outlets[-1].where}", flush=True)
        trouble = Trouble(corrupt, round(partition_every * 1e6), round(partition_for * 1e6))
        rng = np.random.default_rng(seed)
        wires = Chaos(found, outlets, made, trouble, WallClock(realtime_factor), rng)
        if until_eof:
            stop_at_eof(wires)
        stack.enter_context(claimed(PLANT))
        try:
            with signals_stop(wires):
                wires.run()
        except PortError as error:
            raise Failure(ExitCode.DEVICE, str(error)) from error
    print(
        f"{wires.passed} packets passed, {wires.corrupted} of them spoilt; {wires.lost} lost, "
        f"{wires.cut} cut off",
        file=sys.stderr,
    )
    return ExitCode.DONE


def _channel(changes: list[str]) -> Channel:
    """A channel that does nothing but what is asked for. Raises Failure."""
    from pydantic import ValidationError

    from headway.configs.schema import Channel

    values: dict[str, object] = {"delay_us": 0, "jitter_us": 0, "loss": 0.0}
    keys = [key for key in Channel.model_fields if key not in ("frame_us", "slot_us")]
    for change in changes:
        key, _, value = change.partition("=")
        if key not in keys:
            raise Failure(ExitCode.USAGE, f"--set {change}: keys are {', '.join(keys)}")
        values[key] = value
    try:
        return Channel.model_validate(values, strict=False)
    except ValidationError as error:
        first = error.errors()[0]
        place = ".".join(str(part) for part in first["loc"])
        said = f"--set {place}: {first['msg']}".replace("--set : ", "--set: ")
        raise Failure(ExitCode.USAGE, said) from error
