#!/usr/bin/env bash
# micromlgen: a random forest in C++ counts votes of trees, scikit-learn adds probabilities: one answer in eight differs.
#
# Guess:    port(model) gives the answers of model.predict, but for rounding at thresholds. A forest that is kept small for a
#           chip (max_depth) only has fewer comparisons.
# Version:  micromlgen 1.1.28, scikit-learn 1.9.1, numpy 2.4.6, Python 3.11; any g++.
# Input:    the handwritten digits of scikit-learn, whose pixels are whole numbers, so that no threshold is rounded across
#           them; every second one trains, the others are compared. 15 trees, grown to the end, and of depth 4.
# Seen:     each leaf of the C++ gives one vote to its most frequent class, each leaf of scikit-learn its share of each
#           class. Trees that are grown to the end have leaves of one class: all 898 answers are equal. Of depth 4, 109 of
#           898 differ, and the accuracy falls from 0.844 to 0.801.
# Matters:  the forest is compared with a network in Python, and a worse one is shipped; the smaller it is made for the
#           flash, the more it differs. A check with a forest of unlimited depth finds nothing.
# Exits with 1 if it behaves otherwise.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
cd "$folder"
python3 -m venv venv
venv/bin/python -m pip --disable-pip-version-check install --quiet micromlgen==1.1.28 scikit-learn==1.9.1 numpy==2.4.6
venv/bin/python - << 'PYTHON'
import subprocess
import sys
from pathlib import Path

import numpy as np
from micromlgen import port
from sklearn.datasets import load_digits
from sklearn.ensemble import RandomForestClassifier

MAIN = """
#include <cstdarg>
#include <cstdint>
#include <cstdio>
#include "forest.h"
int main() {
    static float x[64];
    Eloquent::ML::Port::RandomForest forest;
    while (std::fread(x, sizeof(float), 64, stdin) == 64)
        std::printf("%d\\n", (int)forest.predict(x));
}
"""
pixels, digits = load_digits(return_X_y=True)
pixels = pixels.astype(np.float32)


def compare(depth):
    model = RandomForestClassifier(15, max_depth=depth, random_state=0).fit(pixels[::2], digits[::2])
    Path("forest.h").write_text(port(model, classname="RandomForest"))
    Path("main.cpp").write_text(MAIN)
    subprocess.run(["g++", "-O1", "-w", "main.cpp", "-o", "forest"], check=True)
    ran = subprocess.run(["./forest"], input=pixels[1::2].tobytes(), capture_output=True, check=True)
    told, said, true = np.array(ran.stdout.split(), dtype=int), model.predict(pixels[1::2]), digits[1::2]
    votes = [np.bincount([int(tree.predict(row[None])[0]) for tree in model.estimators_], minlength=10) for row in pixels[1::2]]
    return {
        "answers": len(told),
        "differ": int((told != said).sum()),
        "differ from the majority of the trees": int((told != np.argmax(votes, axis=1)).sum()),
        "accuracy in Python, in C++": (round(float((said == true).mean()), 3), round(float((told == true).mean()), 3)),
    }


full, shallow = compare(None), compare(4)
print("grown to the end:", full)
print("depth 4:", shallow)
expected = full["answers"] == 898 and full["differ"] == 0 and shallow["differ"] > 60
expected = expected and shallow["differ from the majority of the trees"] == 0
print("as described" if expected else "NOT as described")
sys.exit(0 if expected else 1)
PYTHON
