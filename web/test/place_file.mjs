// place_file.mjs IN OUT T_map_anchor(16 numbers, row-major): decode packed Gaussians and write their records.
// Used by tests/web/test_codec.py, which compares them with the decoder of common/messages.
import { readFileSync, writeFileSync } from "node:fs";
import { decode, place } from "../src/codec.js";

const [from, to, ...T] = process.argv.slice(2);
writeFileSync(to, new Uint8Array(place(await decode(new Uint8Array(readFileSync(from))), T.map(Number)).buffer));
