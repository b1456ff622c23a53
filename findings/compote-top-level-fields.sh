#!/usr/bin/env bash
# idf-component-manager: `compote manifest lint` refuses an unknown key inside a dependency, and passes one beside it.
#
# Guess:    a validator that names an unknown key of a dependency also names an unknown key at the top of the manifest, and
#           a chip that does not exist: `dependancies`, `target` in place of `targets`, `esp31`.
# Version:  idf-component-manager 3.1.2, Python 3.11.
# Input:    manifests of one component without code; `lint` for each, and `component pack` for those that pass.
# Seen:     exit status 1 for `versoin` inside a dependency ("Unknown fields"), for a version that is none and for `targets: 5`;
#           0, without a word, for `dependancies`, `target` and `esp31`. They are packed, too. The schema that
#           `compote manifest schema` prints has no additionalProperties either.
# Matters:  a misspelt `dependencies` builds here, where the dependency lies in the project anyway, and fails at the first
#           user; a misspelt chip hides the component from it. Names have to be compared with the schema by one's own test.
# Exits with 1 if it behaves otherwise.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
cd "$folder"
python3 -m venv venv
venv/bin/python -m pip --disable-pip-version-check install --quiet idf-component-manager==3.1.2
export IDF_TOOLS_PATH="$folder/tools"
mkdir component
echo 'idf_component_register()' > component/CMakeLists.txt
failed=0

# expect STATUS NAME: the status of `lint` for the manifest on standard input; what passes must be packed as well.
expect() {
  local found=0
  cat > component/idf_component.yml
  venv/bin/compote manifest lint component > lint.txt 2>&1 || found=$?
  echo "$2: lint $found $(head -1 lint.txt)"
  [ "$found" -eq "$1" ] || failed=1
  if [ "$found" -eq 0 ]; then
    [ ! -s lint.txt ] || failed=1
    (cd component && ../venv/bin/compote component pack --name toy > ../pack.txt 2>&1) || failed=1
    rm -rf component/dist
  fi
}

expect 1 'versoin in a dependency' << 'YML'
version: "1.0.0"
dependencies:
  other:
    versoin: "1.0"
YML
expect 1 'a version that is none' << 'YML'
version: "one"
YML
expect 1 'targets that are no list' << 'YML'
version: "1.0.0"
targets: 5
YML
expect 0 'dependancies' << 'YML'
version: "1.0.0"
dependancies:
  idf: ">=5.2"
YML
expect 0 'target' << 'YML'
version: "1.0.0"
target: [esp32]
YML
expect 0 'a chip that does not exist' << 'YML'
version: "1.0.0"
targets: [esp31]
YML
venv/bin/compote manifest schema > schema.json 2> /dev/null
python3 -c 'import json; raise SystemExit("additionalProperties" in json.load(open("schema.json")))' || failed=1
exit "$failed"
