"""Set everything up and go: `python3 start.py run` (the main study) or `python3 start.py test` (the tests).

Needs Python 3.11 or newer and pip, nothing else: no compiler, no git, no make. Makes its own environment in `.venv`, installs the
locked versions of requirements/, then this package itself. Running it again skips whatever is already in place.
"""

import hashlib
import os
import shutil
import subprocess
import sys
import time
from pathlib import Path

ROOT = Path(__file__).resolve().parent
ENVIRONMENT = ROOT / ".venv"
RUN_LOCK = ROOT / "requirements" / "lock.txt"
TEST_LOCK = ROOT / "requirements" / "lock-test.txt"
MAIN_JOB = ("run", "studies/brake_reuss_beam/study.toml", "--out", "results/brb")
OLDEST = (3, 11)
SIDE_BY_SIDE = ("-n", "auto", "--maxprocesses", "8", "--dist", "loadfile")  # a process for each core; more than 8 only compile the same


def say(sentence):
    """Tell the user what happens now."""
    print(f"start: {sentence}", flush=True)


def stop(sentence):
    """End with one clear sentence."""
    print(f"start: {sentence}", file=sys.stderr, flush=True)
    raise SystemExit(2)


def environment_python():
    """Path of the interpreter inside the environment."""
    folder, name = ("Scripts", "python.exe") if os.name == "nt" else ("bin", "python")
    return ENVIRONMENT / folder / name


def fingerprint(locks):
    """Hash of all that decides what gets installed: the locks, the package's own metadata, and the Python that runs it."""
    digest = hashlib.sha256(f"{sys.version_info[:3]} {ROOT}".encode())
    for path in (*locks, ROOT / "pyproject.toml"):
        digest.update(path.name.encode() + path.read_bytes())
    return digest.hexdigest()


def usable():
    """Whether the environment exists, starts, and was made by this version of Python."""
    python = environment_python()
    if not python.exists():
        return False
    probe = [str(python), "-c", "import sys; print(*sys.version_info[:3])"]
    answer = subprocess.run(probe, capture_output=True, text=True, check=False)
    return answer.returncode == 0 and answer.stdout.split() == [str(n) for n in sys.version_info[:3]]


def has_pip(python):
    """Whether an interpreter can run pip."""
    return subprocess.run([str(python), "-m", "pip", "--version"], capture_output=True, check=False).returncode == 0


def make_environment():
    """Create `.venv`; where the system's Python comes without ensurepip, without a pip of its own."""
    if ENVIRONMENT.exists():
        if not (ENVIRONMENT / "pyvenv.cfg").exists():
            stop(f"{ENVIRONMENT} exists and is not a Python environment; move it away and run again.")
        say(f"{ENVIRONMENT.name} does not fit Python {sys.version.split()[0]}; making it again")
        shutil.rmtree(ENVIRONMENT)
    say(f"making the environment {ENVIRONMENT} with Python {sys.version.split()[0]}")
    made = subprocess.run([sys.executable, "-m", "venv", str(ENVIRONMENT)], capture_output=True, text=True, check=False)
    if made.returncode == 0:
        return
    say("this Python cannot put pip into a new environment (ensurepip is missing); using the pip you already have from outside")
    shutil.rmtree(ENVIRONMENT, ignore_errors=True)
    bare = subprocess.run([sys.executable, "-m", "venv", "--without-pip", str(ENVIRONMENT)], capture_output=True, text=True, check=False)
    if bare.returncode:
        stop(f"Python could not make an environment: {(bare.stderr or bare.stdout).strip().splitlines()[-1:]}; install python3-venv.")


def installer():
    """The pip command that installs into the environment."""
    if has_pip(environment_python()):
        return [str(environment_python()), "-m", "pip"]
    if not has_pip(sys.executable):
        stop("neither the new environment nor this Python has pip; install pip (for instance the package python3-pip) and run again.")
    return [sys.executable, "-m", "pip", "--python", str(environment_python())]


def pip(arguments, purpose):
    """Run pip quietly; on failure stop with its last words."""
    command = [*installer(), "--disable-pip-version-check", "install", "--quiet", "--no-input", *arguments]
    if subprocess.run(command, cwd=ROOT, check=False).returncode:
        stop(f"pip could not install {purpose} (its own message stands above); check the connection to the package index and run again.")


def set_up(locks):
    """Bring `.venv` to the state the locks ask for; nothing happens if it is there already.

    Setting up for the tests includes what a run needs, so that going back and forth installs nothing twice.
    """
    stamp = ENVIRONMENT / "start.stamp"
    states = {fingerprint((RUN_LOCK, TEST_LOCK)), fingerprint(tuple(locks))}
    if usable() and stamp.exists() and stamp.read_text(encoding="utf-8") in states:
        return
    begun = time.monotonic()
    if not usable():
        make_environment()
    stamp.unlink(missing_ok=True)
    say("installing the locked versions of " + " and ".join(str(lock.relative_to(ROOT)) for lock in locks))
    chosen = [word for lock in locks for word in ("--requirement", str(lock))]
    pip(["--only-binary", ":all:", *chosen], "the locked dependencies")
    say("installing bayes_nlsid itself")
    pip(["--no-deps", "--no-build-isolation", "--editable", str(ROOT)], "bayes_nlsid")
    stamp.write_text(fingerprint(tuple(locks)), encoding="utf-8")
    say(f"set up in {time.monotonic() - begun:.0f} s")


def call(arguments):
    """Run something with the environment's Python and hand its exit status on.

    Linear algebra gets one thread unless the user says otherwise: the matrices are small, and threads that wait for each other on a
    busy machine doubled the CPU time of the main job.
    """
    single = {name: "1" for name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")}
    single.update(os.environ)
    try:
        return subprocess.run([str(environment_python()), *arguments], cwd=ROOT, env=single, check=False).returncode
    except KeyboardInterrupt:
        return 130


def main(arguments):
    """`run` and `test`; anything after the word is handed on to nlsid or pytest (`-n 0` for one process)."""
    if sys.version_info < OLDEST:
        needed = ".".join(str(number) for number in OLDEST)
        stop(f"Python {needed} or newer is needed, this is {sys.version.split()[0]}; use for instance python3.12.")
    word, rest = (arguments[0] if arguments else "--help"), list(arguments[1:])
    if word == "run":
        set_up([RUN_LOCK])
        return call(["-m", "bayes_nlsid", *MAIN_JOB, *rest])
    if word == "test":
        set_up([RUN_LOCK, TEST_LOCK])
        return call(["-m", "pytest", *SIDE_BY_SIDE, *rest])
    if word == "setup":
        set_up([RUN_LOCK, TEST_LOCK])
        return 0
    print(__doc__ + "\nAlso: `python3 start.py setup` only sets up. Further words go to nlsid or to pytest.")
    return 0 if word in ("-h", "--help") else 2


if __name__ == "__main__":
    try:
        raise SystemExit(main(sys.argv[1:]))
    except KeyboardInterrupt:
        raise SystemExit(130) from None
