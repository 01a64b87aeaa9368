"""Basalt from the wheel `depthai` (node BasaltVIO, on the host, no camera) at the end of a pipe.

    PYTHON share/lab/peer_trackers/basalt.py [--version]

`share evaluate compare` runs it in the interpreter of an environment with `depthai`; see peer_wire. It takes
one frame at a time and answers before it reads the next, so none is dropped and each pose is of the frame
just sent (the node does not stamp it). Settings: as shipped. Calibration, IMU noise: the recording's.
"""

from __future__ import annotations

import ctypes
import mmap
import os
import sys
import threading
import time
from datetime import timedelta
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from peer_wire import PeerFrame, claim_stdout, pose_matrix, read_frame, read_line, write_line

ANSWER_STREAM = claim_stdout()  # the library logs to stdout, from its import on

import depthai as dai  # noqa: E402

F64 = NDArray[np.float64]

LEFT, RIGHT = dai.CameraBoardSocket.CAM_B, dai.CameraBoardSocket.CAM_C
CM = 100.0
T_camera_flu = np.array([[0.0, -1, 0, 0], [0, 0, -1, 0], [1, 0, 0, 0], [0, 0, 0, 1]])
STARTUP_S, TIMEOUT = 1.0, timedelta(seconds=60)


class Basalt:
    """Basalt on a rig. `calibration`: see `share.lab.evaluate.tracker_runs.rig_calibration`."""

    def __init__(self, calibration: dict[str, Any]) -> None:
        cameras = calibration["cameras"]
        self.T_flu_body = np.linalg.inv(np.array(cameras[0]["T_body_cam"]) @ T_camera_flu)
        self.half_sample_ns = round(0.5e9 / calibration["imu"]["rate_hz"])
        self.handler = calibration_handler(cameras)
        self.calibration_requested, self.keep_alive = intercept_calibration(self.handler)
        self.pipeline = dai.Pipeline(False)
        node = self.pipeline.create(dai.node.BasaltVIO)
        node.runSyncOnHost(True)
        set_imu_noise(node, calibration["imu"])
        self.left, self.right = node.left.createInputQueue(), node.right.createInputQueue()
        self.imu = node.imu.createInputQueue()
        self.out = node.transform.createOutputQueue()
        self.pipeline.start()
        self.frame_count = 0

    def pose(self, peer_frame: PeerFrame, start_ns: int) -> tuple[F64, float]:
        """Return T_world_body and the CPU time, s, of all threads. Stamps are sent relative to start_ns."""
        images = ((self.left, LEFT, peer_frame.left), (self.right, RIGHT, peer_frame.right))
        frames = [
            (queue, self._image_frame(s, image, peer_frame.stamp_ns - start_ns)) for queue, s, image in images
        ]
        # the library holds a sample for the interval that ends with it; these are of one instant, its middle
        samples = imu_message(peer_frame.imu_ns - start_ns + self.half_sample_ns, peer_frame.imu)
        cpu_start_s = time.process_time()
        for queue, frame in frames:
            queue.send(frame)
        if self.frame_count == 0:  # IMU samples sent before the node is set up are lost
            self.calibration_requested.wait()
            time.sleep(STARTUP_S)
        self.imu.send(samples)
        answer = self.out.get(TIMEOUT)
        if answer is None:
            raise TimeoutError(f"no pose of frame {self.frame_count} within {TIMEOUT.seconds} s")
        self.frame_count += 1
        cpu_s = time.process_time() - cpu_start_s
        q, t = answer.getQuaternion(), answer.getTranslation()
        T = pose_matrix(np.array([t.x, t.y, t.z]), np.array([q.qx, q.qy, q.qz, q.qw]))
        return T @ self.T_flu_body, cpu_s

    def _image_frame(self, socket: Any, image: NDArray[np.uint8], stamp_ns: int) -> Any:
        frame, timestamp = dai.ImgFrame(), timedelta(microseconds=stamp_ns // 1000)
        frame.setType(dai.ImgFrame.Type.GRAY8)
        frame.setWidth(image.shape[1])
        frame.setHeight(image.shape[0])
        frame.setData(image.ravel())
        frame.setTimestamp(timestamp)
        frame.setTimestampDevice(timestamp)
        frame.setSequenceNum(self.frame_count)
        frame.setInstanceNum(int(socket.value))
        return frame


def calibration_handler(cameras: list[dict[str, Any]]) -> Any:
    """Return the cameras as a `depthai` calibration: cm, 14 coefficients of which radtan's five come first.

    Raises ValueError if the library reads back other camera poses than were set.
    """
    out = dai.CalibrationHandler()
    for socket, camera in zip((LEFT, RIGHT), cameras, strict=True):
        coefficients = [*camera["distortion"], *[0.0] * 14][:14]
        out.setCameraIntrinsics(socket, camera["K"], camera["width"], camera["height"])
        out.setDistortionCoefficients(socket, coefficients)
        out.setCameraType(socket, dai.CameraModel.Perspective)
    T_left, T_right = (np.array(camera["T_body_cam"]) for camera in cameras)
    out.setCameraExtrinsics(LEFT, RIGHT, *extrinsic_arguments(np.linalg.inv(T_right) @ T_left))
    out.setImuExtrinsics(LEFT, *extrinsic_arguments(np.linalg.inv(T_left)))
    for socket, T in ((LEFT, T_left), (RIGHT, T_right)):
        read_back = np.array(out.getCameraToImuExtrinsics(socket, True))
        read_back[:3, 3] /= CM
        if np.abs(read_back - T).max() > 1e-6:
            raise ValueError(f"{socket}: depthai has its pose as {read_back.tolist()}, not {T.tolist()}")
    return out


def extrinsic_arguments(T: F64) -> tuple[list[list[float]], list[float], list[float]]:
    """Return rotation, and translation in cm, as measured and as designed."""
    t = (CM * T[:3, 3]).tolist()
    return T[:3, :3].tolist(), t, t


def set_imu_noise(node: Any, imu: dict[str, float]) -> None:
    """Set the IMU noise. The node takes the square root of its argument as the density; bias walks stay as
    shipped."""
    node.setImuUpdateRate(round(imu["rate_hz"]))
    node.setGyroNoiseStd([imu["gyro_density"] ** 2] * 3)
    node.setAccelNoiseStd([imu["accel_density"] ** 2] * 3)


def imu_message(stamps_ns: NDArray[np.int64], values: F64) -> Any:
    """Return one message with all samples."""
    packets = []
    for stamp, sample in zip(stamps_ns.tolist(), values.tolist(), strict=True):
        packet = dai.IMUPacket()
        for name, xyz in (("gyroscope", sample[:3]), ("acceleroMeter", sample[3:])):
            report = getattr(packet, name)
            timestamp = report.timestamp
            timestamp.sec, timestamp.nsec = divmod(stamp, 10**9)
            report.timestamp = timestamp
            report.x, report.y, report.z = xyz
            setattr(packet, name, report)
        packets.append(packet)
    out = dai.IMUData()
    out.packets = packets
    return out


def intercept_calibration(handler: Any) -> tuple[threading.Event, Any]:
    """Answer the node's request for its camera's calibration with `handler`, since there is no camera.

    Return an event, set when it has asked, and objects to keep alive until the end. Overwrites the start of
    one library function by a jump; nothing else is changed. Linux on x86-64 only.
    """
    requested = threading.Event()
    maps = Path("/proc/self/maps").read_text().split("\n")
    library = ctypes.CDLL(next(line.split()[-1] for line in maps if "libdepthaicore" in line))
    construct = library._ZN3dai18CalibrationHandlerC1ERKNS_10EepromDataESt8optionalIbE
    construct.argtypes, construct.restype = (ctypes.c_void_p, ctypes.c_void_p, ctypes.c_uint16), None
    eeprom = handler.getEepromData()
    native_pointer = ctypes.c_void_p.from_address(
        id(eeprom) + object.__basicsize__
    ).value  # behind Python's header

    def answer(result: int, _camera: int) -> int:
        construct(result, native_pointer, 0)
        requested.set()
        return result

    function = ctypes.CFUNCTYPE(ctypes.c_void_p, ctypes.c_void_p, ctypes.c_void_p)(answer)
    patch_function(library._ZN3dai10DeviceBase14getCalibrationEv, function)
    return requested, (eeprom, function)


def patch_function(function: Any, replacement: Any) -> None:
    """Write `mov rax, replacement; jmp rax` at the start of a function."""
    address, target = (ctypes.cast(f, ctypes.c_void_p).value or 0 for f in (function, replacement))
    page = address // mmap.PAGESIZE * mmap.PAGESIZE
    protect = ctypes.CDLL(None, use_errno=True).mprotect
    permissions = mmap.PROT_READ | mmap.PROT_WRITE | mmap.PROT_EXEC
    if protect(ctypes.c_void_p(page), ctypes.c_size_t(2 * mmap.PAGESIZE), permissions):
        raise OSError(ctypes.get_errno(), "the library's code cannot be made writable")
    code = b"\x48\xb8" + target.to_bytes(8, "little") + b"\xff\xe0"
    ctypes.memmove(address, code, len(code))


def main() -> None:
    if "--version" in sys.argv:
        write_line(ANSWER_STREAM, {"version": f"Basalt of depthai {version('depthai')}"})
        return
    calibration = read_line(sys.stdin.buffer)
    assert calibration is not None
    basalt, start_ns = Basalt(calibration), None
    while (frame := read_frame(sys.stdin.buffer)) is not None:
        start_ns = int(frame.imu_ns[0]) - 10**9 if start_ns is None else start_ns
        T, cpu_s = basalt.pose(frame, start_ns)
        write_line(ANSWER_STREAM, {"T_world_body": T.tolist(), "cpu_s": cpu_s})
    sys.stderr.flush()
    os._exit(0)  # the node's threads end with the process


if __name__ == "__main__":
    main()
