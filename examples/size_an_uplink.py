"""Plot the vehicles that a cell carries over quality: python examples/size_an_uplink.py

This is what ``rfedge size`` prints, from Python (docs/how-to/sizing.md says how).
"""

from dataclasses import replace

from rfedge.sizing.estimate import Assumptions, Demand, estimate
from rfedge.sizing.tables import shipped_tables


def main():
    """Print Mbit/s and vehicles a cell of ours and of x264 at three qualities."""
    tables = shipped_tables()
    rural = Assumptions(bits_per_hz=1.6, inter_site_m=1732.0)
    four_cameras = Demand(cameras=4, width_px=640, height_px=360, hz=10.0, psnr_db=34.0)
    for psnr_db in (33.0, 34.0, 35.0):
        sizing = estimate(replace(four_cameras, psnr_db=psnr_db), tables, rural)
        for row in sizing.estimates:
            if row.codec in ("rfedge", "x264"):
                interval = f"{row.low_mbps:.2f} to {row.high_mbps:.2f}"
                print(
                    f"{psnr_db:g} dB, {row.codec}: {row.mbps:.2f} Mbit/s ({interval}), "
                    f"{row.vehicles_per_cell} vehicles a cell"
                )
        for note in sizing.beyond:
            print(f"  beyond what was measured: {note}")


if __name__ == "__main__":
    main()
