// Which chunks are fetched and shown, with a feed of real packed bytes that answers when the test says so.
import assert from "node:assert/strict";
import { test } from "node:test";
import { deflateSync } from "node:zlib";
import { ChunkStore } from "../src/chunks.js";
import { WORDS, decode } from "../src/codec.js";
import { Gone } from "../src/feed.js";

const identity = [1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1];

/** Packed Gaussians, all in one place. */
function packed(count, at) {
  const head = Buffer.alloc(32);
  head.write("SPL1");
  head.writeUInt32LE(count, 4);
  [...at, ...at].forEach((v, i) => head.writeFloatLE(v, 8 + 4 * i));
  const planes = Buffer.alloc(17 * count, 127);
  return new Uint8Array(Buffer.concat([head, deflateSync(planes)]));
}

const entry = (anchor, revision, count, T = identity) => ({ anchor, revision, T_map_anchor: T, low: [0, 0, 0], high: [1, 1, 1], levels: [{ cell_m: 0, count, bytes: 0 }] });
const index = (producer, ...chunks) => ({ producer, revision: 1, chunks, keyframes: [], camera: null });

/** Wait until a condition holds: decoding is asynchronous. */
async function until(condition) {
  for (const end = Date.now() + 30_000; !condition() && Date.now() < end;) await new Promise((resolve) => setTimeout(resolve, 5));
}

function store(answers) {
  const asked = [], failures = [];
  const feed = { chunk: async (chunk, _cell, producer) => { asked.push(`${producer}:${chunk.anchor}.${chunk.revision}`); return answers(chunk); }, refresh: () => asked.push("index") };
  const made = new ChunkStore(feed, () => {}, (text) => failures.push(text));
  return { made, asked, failures, choose: () => made.choose([0, 0, 0], 500, 1e6) };
}

test("a chunk is replaced when its revision changes, moved without a request, and removed", async () => {
  const { made, asked, choose } = store((chunk) => packed(chunk.revision === 1 ? 3 : 5, [1, 2, 3]));
  made.update(index("a", entry(4, 1, 3), entry(5, 1, 3)));
  choose();
  assert.equal(made.complete, false);
  await until(() => made.complete);
  assert.deepEqual([made.count, made.complete, asked.length], [6, true, 2]);
  made.update(index("a", entry(4, 2, 5, identity.with(3, 10)), entry(5, 1, 3, identity.with(3, 100))));
  choose();
  await until(() => made.complete);
  assert.deepEqual(asked, ["a:4.1", "a:5.1", "a:4.2"]);
  const floats = new Float32Array(made.assemble().buffer), xs = Array.from({ length: 8 }, (_, i) => floats[i * WORDS]);
  assert.deepEqual(xs, [11, 11, 11, 11, 11, 101, 101, 101]);
  made.update(index("a", entry(5, 1, 3)));
  choose();
  assert.equal(made.count, 3);
});

test("another producer is another map", async () => {
  const { made, asked, choose } = store(() => packed(2, [0, 0, 0]));
  made.update(index("a", entry(1, 7, 2)));
  choose();
  await until(() => made.complete);
  made.update(index("b", entry(1, 7, 2)));
  assert.equal(made.count, 0);
  choose();
  await until(() => made.complete);
  assert.deepEqual([made.count, asked], [2, ["a:1.7", "b:1.7"]]);
});

test("a revision that is gone asks for the index, damaged bytes are reported, others are shown", async () => {
  const { made, asked, failures, choose } = store((chunk) => {
    if (chunk.anchor === 1) throw new Gone("gone");
    return chunk.anchor === 2 ? packed(2, [0, 0, 0]).slice(0, 40) : packed(2, [0, 0, 0]);
  });
  made.update(index("a", entry(1, 1, 2), entry(2, 1, 2), entry(3, 1, 2)));
  choose();
  await until(() => made.count && failures.length);
  assert.equal(made.count, 2);
  assert.ok(asked.includes("index"));
  assert.equal(failures.length, 1);
  made.close(); // no further tries
});

test("bytes that are no packed Gaussians are refused", async () => {
  await assert.rejects(decode(new Uint8Array(10)), /SPL1/);
  await assert.rejects(decode(new TextEncoder().encode("ply\nformat binary_little_endian 1.0\n")), /SPL1/);
  const short = packed(2, [0, 0, 0]);
  short[4] = 3; // says three Gaussians
  await assert.rejects(decode(short), /truncated: 34 bytes for 3/);
  const nan = packed(2, [NaN, 0, 0]);
  await assert.rejects(decode(nan), /damaged/);
});
