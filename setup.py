"""Where the packages are, found instead of listed: runtime/ is `apc`, compiler/ and models/ stand in it."""

from setuptools import find_packages, setup

ROOTS = {"apc": "runtime", "apc.compiler": "compiler", "apc.models": "models"}

setup(
    packages=[
        p for name, folder in ROOTS.items() for p in (name, *(f"{name}.{p}" for p in find_packages(folder)))
    ],
    package_dir=ROOTS,
)
