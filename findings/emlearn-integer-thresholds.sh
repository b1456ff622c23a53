#!/bin/sh
# emlearn: a tree of integers, the default, sends the value below each threshold of a half to the wrong side, if positive.
#
# Guess:     a tree learned from integers that fit into 16 bits is the same tree in C: convert() has dtype int16_t by
#            default, and x <= 12.5 is x <= 12 for integers.
# Version:   emlearn 0.23.2, scikit-learn 1.9.1, numpy 2.3.5; cc for the C code, which emlearn itself builds for predict().
# Input:     a few values of one feature, each with its class, learned without an error by scikit-learn's tree.
# Behaviour: the threshold is cut off towards zero and compared with <, not <=: x <= 12.5 becomes x < 12, and 12 goes to the
#            other side. Below zero the same cut is right: x <= -12.5 becomes x < -12. A branch on a feature that is 0 or
#            1 always goes the same way. No warning; `loadable` and `inline` alike. With dtype float (inline only) halves
#            are right, and only a value equal to a threshold, as 13 between 12 and 14, goes to the other side.
# Output:    (with the first comparison of the tree)
#            learned 0 1: 1 of 2 as in scikit-learn, if (features[0] < 0)
#            learned 0 1 2 3 4 5: 1 of 6 as in scikit-learn, if (features[0] < 0)
#            learned -6 -5 -4 -3 -2 -1: 6 of 6 as in scikit-learn, if (features[0] < -5)
#            float, learned 0 1 2 3 4 5: 6 of 6 as in scikit-learn, if (features[0] < 0.500000f)
#            float, learned 12 14, asked 12 13 14: 2 of 3 as in scikit-learn, if (features[0] < 13.000000f)
# Why it matters: contacts, counts and coarse ADC values are such features. The classes on the chip differ from those of the
#            evaluation, and more for small values than for large, which looks like a loss by quantization.
#
# Exits with 0 while this is so. Installs the packages in a temporary folder.
set -eu
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/pip" --disable-pip-version-check install --quiet emlearn==0.23.2 scikit-learn==1.9.1 numpy==2.3.5
cd "$folder"
venv/bin/python -W ignore - <<'END'
import emlearn
import numpy as np
from sklearn.tree import DecisionTreeClassifier


def alike(learned, dtype="int16_t", asked=None):
    """Return for how many values the C code gives the class that scikit-learn's tree gives."""
    learned = list(learned)
    values = np.array(asked or learned, dtype=float)[:, None]
    classes = np.arange(len(learned))
    tree = DecisionTreeClassifier(random_state=0).fit(np.array(learned, dtype=float)[:, None], classes)
    assert asked or (tree.predict(values) == classes).all()
    counts = set()
    for method in ("inline",) if dtype == "float" else ("loadable", "inline"):
        converted = emlearn.convert(tree, method=method, dtype=dtype)
        counts.add(int((converted.predict(values) == tree.predict(values)).sum()))
    (count,) = counts
    converted.save(name="tree", file="tree.h")
    comparison = next(line.split(" {")[0].strip() for line in open("tree.h") if "if (features" in line)
    name = ("float, " if dtype == "float" else "") + "learned " + " ".join(map(str, learned))
    name += ", asked " + " ".join(map(str, asked)) if asked else ""
    print(f"{name}: {count} of {len(values)} as in scikit-learn, {comparison}")
    return count


seen = [
    alike([0, 1]),
    alike(range(6)),
    alike(range(-6, 0)),
    alike(range(6), "float"),
    alike([12, 14], "float", [12, 13, 14]),
]
raise SystemExit(0 if seen == [1, 1, 6, 6, 2] else f"This has changed: {seen}")
END
