"""A camera on the network, by GStreamer under the system's Python: ``rtsp`` or ``rtp``.

``gst_sender.py rtsp PICTURES PORT`` serves rtsp://127.0.0.1:PORT/camera; PORT 0 takes a free one.
``file FILE PORT LOST`` serves the H.264 of a Matroska file, without a share LOST of its pictures.
``rtp PICTURES PORT`` sends RTP and sender reports to PORT and PORT + 1. PICTURES is a pattern like
``folder/%03d.jpg``: coded as H.264 at 10 Hz, over and over. Prints the port once it is ready.
"""

import sys

import gi

gi.require_version("Gst", "1.0")
gi.require_version("GstRtspServer", "1.0")
from gi.repository import GLib, Gst, GstRtspServer  # noqa: E402

CODER = "jpegdec ! videoconvert ! video/x-raw,format=I420 ! x264enc tune=zerolatency key-int-max=10"
PAYLOADER = "h264parse config-interval=-1 ! rtph264pay name=pay0 pt=96 mtu=1300"


def source(pictures: str) -> str:
    """Return the pipeline that codes pictures at 10 Hz, at the speed of their times."""
    still = f"multifilesrc location={pictures} loop=true caps=image/jpeg,framerate=10/1"
    return f"{still} ! identity sync=true ! {CODER} speed-preset=veryfast bitrate=4000 "


def serve(pictures: str, port: str) -> None:
    """Serve pictures by RTSP until killed."""
    serve_pipeline(f"{source(pictures)} ! {PAYLOADER}", port)


def serve_file(file: str, port: str, lost: str) -> None:
    """Serve a coded stream by RTSP."""
    units = f"filesrc location={file} ! matroskademux ! h264parse ! video/x-h264,alignment=au"
    serve_pipeline(f"{units} ! identity drop-probability={lost} ! {PAYLOADER}", port)


def serve_pipeline(pipeline: str, port: str) -> None:
    """Serve what a pipeline sends until killed."""
    server = GstRtspServer.RTSPServer()
    server.set_address("127.0.0.1")
    server.set_service(port)
    factory = GstRtspServer.RTSPMediaFactory()
    factory.set_launch(f"( {pipeline} )")
    factory.set_shared(True)
    server.get_mount_points().add_factory("/camera", factory)
    server.attach(None)
    print(server.get_bound_port(), flush=True)


def send(pictures: str, port: str) -> None:
    """Send RTP and RTCP to two ports until killed."""
    to, reports = int(port), int(port) + 1
    pipeline = Gst.parse_launch(
        f"rtpbin name=r {source(pictures)} ! {PAYLOADER} ! r.send_rtp_sink_0 "
        f"r.send_rtp_src_0 ! udpsink host=127.0.0.1 port={to} "
        f"r.send_rtcp_src_0 ! udpsink host=127.0.0.1 port={reports} sync=false async=false"
    )
    pipeline.set_state(Gst.State.PLAYING)
    print(port, flush=True)


if __name__ == "__main__":
    Gst.init(None)
    {"rtsp": serve, "file": serve_file, "rtp": send}[sys.argv[1]](*sys.argv[2:])
    GLib.MainLoop().run()
