"""Coverage-guided fuzzing of the readers: ``python tests/fuzz/fuzz.py SECONDS [TARGET ...]``.

Each target (``targets.py``; all unless named) runs for SECONDS in a process of its own under
atheris, which is libFuzzer for Python: inputs that reach new branches of ours are kept and changed
further. It starts from ``corpus/TARGET`` and what an earlier run left in ``out/fuzz/TARGET``. An
input that raises what is not an ``RfedgeError``, takes 10 s or 1 GB is written to
``crashers/TARGET``, and the exit status is 1; mend it and commit the input, which
``test_crashers.py`` reads from then on.
"""

import importlib.util
import subprocess
import sys
from pathlib import Path

HERE = Path(__file__).parent
OUT = Path("out/fuzz")
MAX_INPUT_BYTES = 8192


def load_sources_plainly() -> str:
    """Have our packages loaded from the checkout; return the folder of the compiled extension.

    atheris sees no coverage in what the finder of an editable installation loads, and says no more
    than that this finder is unusual.
    """
    spec = importlib.util.find_spec("rfcore.native._native")
    assert spec.origin is not None
    for name in [name for name in sys.modules if name.partition(".")[0] == "rfcore"]:
        del sys.modules[name]
    sys.meta_path[:] = [x for x in sys.meta_path if not type(x).__module__.startswith("_editable_")]
    sys.path.insert(0, str(HERE.parents[1]))
    return str(Path(spec.origin).parent)


def run_target(name: str, seconds: str) -> None:
    """Fuzz one target; ends the process."""
    import atheris

    extension = load_sources_plainly()
    with atheris.instrument_imports(include=["rfcore", "mec_server"]):
        import rfcore.native

        rfcore.native.__path__.append(extension)
        from targets import TARGETS
    found, crashers = OUT / name, HERE / "crashers" / name
    for folder in (found, crashers):
        folder.mkdir(parents=True, exist_ok=True)
    options = {
        "max_total_time": seconds,
        "max_len": MAX_INPUT_BYTES,
        "timeout": 10,
        "rss_limit_mb": 1024,
        "artifact_prefix": f"{crashers}/",
        "print_final_stats": 1,
        "verbosity": 0,
    }
    words = [f"-{option}={value}" for option, value in options.items()]
    atheris.Setup([sys.argv[0], *words, str(found), str(HERE / "corpus" / name)], TARGETS[name])
    atheris.Fuzz()


def main() -> int:
    """Run the targets one after the other; return the exit status."""
    if sys.argv[1] == "--target":
        run_target(sys.argv[2], sys.argv[3])
    seconds, *names = sys.argv[1:]
    names = names or sorted(path.name for path in (HERE / "corpus").iterdir())
    failed = []
    for name in names:
        print(f"== {name}, {seconds} s", flush=True)
        command = [sys.executable, str(Path(__file__)), "--target", name, seconds]
        if subprocess.run(command).returncode:
            failed.append(name)
    if failed:
        print(f"crashers in {HERE / 'crashers'}: {', '.join(failed)}")
    return 1 if failed else 0


if __name__ == "__main__":
    sys.exit(main())
