"""Where the ports of a plant in another process are found: in a folder, under stable names.

MACHINE-DEVICE is a link to a pty, MACHINE-DEVICE.udp a file with an address. The number of a pty
and of a free UDP port change from start to start; these names do not.
"""

from __future__ import annotations

import os
import tempfile
from glob import glob
from pathlib import Path

from serial.tools import list_ports

from headway.configs.schema import Links
from headway.devices.port import Port, PortError, SerialPort, UdpPort

UDP_SUFFIX = ".udp"


def default_folder() -> Path:
    """Of this user, and gone with the computer's next start."""
    runtime = os.environ.get("XDG_RUNTIME_DIR")
    if runtime:
        return Path(runtime) / "headway"
    return Path(tempfile.gettempdir()) / f"headway-{os.geteuid()}"


def own_folder(folder: Path) -> None:
    """Makes a folder that nobody else may write into. Raises PortError."""
    try:
        folder.mkdir(mode=0o700, parents=True, exist_ok=True)
        status = folder.stat()
    except OSError as error:
        raise PortError(f"{folder}: cannot be made: {error.strerror}") from error
    if status.st_uid != os.geteuid() or status.st_mode & 0o022:
        raise PortError(f"{folder}: others may write there: remove it, or name another --ports")


def serial_place(folder: Path, machine: str, device: str) -> Path:
    """Of a device's pty."""
    return folder / f"{machine}-{device}"


def udp_place(folder: Path, machine: str, device: str) -> Path:
    """Of a device's address."""
    return folder / f"{machine}-{device}{UDP_SUFFIX}"


def address_of(text: str) -> tuple[str, int]:
    """HOST:PORT as host and number. Raises PortError."""
    host, _, port = text.strip().rpartition(":")
    if not host or not port.isdecimal() or not 0 < int(port) < 65536:
        raise PortError(f"{text.strip()!r} is no address: write HOST:PORT, as 127.0.0.1:47001")
    return host, int(port)


def places_of(folder: Path, links: Links, udp: bool) -> tuple[list[str], list[str]]:
    """Paths of serial ports, or addresses: those that plants have left in the folder and those of
    the config; and why what could not be read was not."""
    found, failed = list[str](), list[str]()
    for path in sorted(folder.iterdir()) if folder.is_dir() else []:
        if (path.suffix == UDP_SUFFIX) != udp or path.name.startswith("."):
            continue
        try:
            found.append(path.read_text().strip() if udp else str(path))
        except OSError as error:
            failed.append(f"{path}: cannot be read: {error.strerror}")
    if udp:
        found += links.udp
    else:
        found += sorted(path for pattern in links.serial for path in glob(pattern))
    return list(dict.fromkeys(found)), failed


def open_place(text: str) -> Port:
    """One that somebody names: a path, an address, or a file with an address as plants leave it.
    Raises PortError."""
    path = Path(text)
    try:
        if path.suffix == UDP_SUFFIX:
            return UdpPort(address_of(path.read_text()))
        if path.exists():
            return SerialPort(text)
    except OSError as error:
        raise PortError(f"{text}: cannot be read: {error.strerror}") from error
    if ":" not in text:
        raise PortError(f"{text}: there is no such port, and it is no address, as 127.0.0.1:47001")
    return UdpPort(address_of(text))


def open_places(folder: Path, links: Links, udp: bool) -> tuple[list[Port], list[str]]:
    """Opens all that is there, of one kind; and why what could not be opened was not."""
    found, failed = places_of(folder, links, udp)
    ports = list[Port]()
    for place in found:
        try:
            ports.append(UdpPort(address_of(place)) if udp else SerialPort(place))
        except PortError as error:
            failed.append(str(error))
    return ports, failed


def usb_of(path: str) -> str:
    """VENDOR:PRODUCT:SERIAL of the USB device behind a serial port, by any of its names; "" for
    others."""
    for port in list_ports.comports(include_links=True):
        if port.device == path and port.vid is not None:
            return f"{port.vid:04x}:{port.pid:04x}:{port.serial_number or ''}".rstrip(":")
    return ""
