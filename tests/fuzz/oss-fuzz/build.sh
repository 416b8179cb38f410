#!/bin/bash -eu
# Builds the fuzzer of the readers, with its corpus. The readers need neither torch nor weights.
pip3 install --constraint constraints.txt numpy laspy lazrs pyarrow python-neo-lzf zstandard
pip3 install --no-deps .
python3 tests/fuzz/fuzz_readers.py --corpus "$WORK/corpus"
zip --quiet --junk-paths "$OUT/fuzz_readers_seed_corpus.zip" "$WORK"/corpus/*
printf '[libfuzzer]\nrss_limit_mb = 700\ntimeout = 10\n' > "$OUT/fuzz_readers.options"
compile_python_fuzzer tests/fuzz/fuzz_readers.py
