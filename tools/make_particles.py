"""Write src/cgemit/particles/particles.csv: stable and long-lived particles, from the package `particle` of PyPI.

Long-lived is what flies farther than 10 nm in its lifetime (c tau), which keeps the neutral pion and leaves out what
decays by the strong interaction.
"""

from __future__ import annotations

import argparse
import csv
from pathlib import Path

import particle
from particle import Particle

LEAST_C_TAU = 1e-5  # mm
#: Names that cgemit has always used; the others are those of EvtGen.
NAMES = {
    2212: "p", -2212: "anti-p", 2112: "n", -2112: "anti-n", 130: "K0_L", 310: "K0_S",
    3122: "Lambda", -3122: "anti-Lambda", 3322: "Xi0", -3322: "anti-Xi0",
    1000020030: "He3", -1000020030: "anti-He3", 1000020040: "alpha", -1000020040: "anti-alpha",
}  # fmt: skip
#: Massless neutrinos and light nuclei, which the package has without a lifetime.
NUCLEI = (1000010020, 1000010030, 1000020030, 1000020040)
STABLE = (12, -12, 14, -14, 16, -16, *(sign * number for number in NUCLEI for sign in (1, -1)))
GLUON = 21
#: Ground states, which the package does not tell: CODATA 2022.
SPINS = {1000010020: 1.0, 1000010030: 0.5, 1000020030: 0.5, 1000020040: 0.0}
#: GeV/c2, of helium without its electrons, which the package counts: CODATA 2022.
MASSES = {1000020030: 2.80839161117, 1000020040: 3.7273794118}


def rows() -> list[tuple[int, str, int, float, float, float]]:
    """Return PDG number, name, charge (e), mass (GeV/c2), spin and lifetime (ns) of each particle."""
    found = Particle.findall(lambda one: (one.ctau or 0) > LEAST_C_TAU and one.mass is not None)
    hadrons = [one for one in found if int(one.pdgid) != GLUON and abs(int(one.pdgid)) < 10**9]
    kept = hadrons + [Particle.from_pdgid(number) for number in STABLE]
    table = []
    for one in sorted(kept, key=lambda one: (abs(int(one.pdgid)), -int(one.pdgid))):
        number = int(one.pdgid)
        lifetime = float("inf") if number in STABLE else float(f"{one.lifetime:.7g}")
        mass = MASSES.get(abs(number), round((one.mass or 0.0) * 1e-3, 15))  # MeV to GeV
        spin = SPINS[abs(number)] if one.J is None else float(one.J)
        table.append((number, NAMES.get(number, one.evtgen_name), int(one.charge), mass, spin, lifetime))
    return table


def main() -> None:
    """Write the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("path", type=Path, help="file to write, such as src/cgemit/particles/particles.csv")
    path = parser.parse_args().path
    with path.open("w", newline="", encoding="utf-8") as file:
        file.write(
            f"# Stable and long-lived particles (c tau above 10 nm), written by tools/make_particles.py from the\n"
            f"# package particle {particle.__version__}, which holds the tables of the Particle Data Group.\n"
        )
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(["pdg", "name", "charge", "mass_gev", "spin", "lifetime_ns"])
        writer.writerows(rows())


if __name__ == "__main__":
    main()
