// A client of the gateway in another language: Node 18 or newer, and no package.
//
//     node examples/client.mjs http://127.0.0.1:8000 3
//
// It opens a session and posts whole frames. Its maps are zeros: real ones come from the vehicle's own encoder.

process.on('uncaughtException', (error) => {
  console.error(error.message, error.cause?.message ?? '');
  process.exit(1);
});

const [gateway = 'http://127.0.0.1:8000', frames = '3'] = process.argv.slice(2);
if (!/^\d+$/.test(frames)) throw new Error(`the number of frames must be whole, not ${frames}`);

/** A value as msgpack: maps, arrays, strings, binary and numbers are all that a frame needs. */
function pack(value) {
  if (Buffer.isBuffer(value)) return Buffer.concat([head(0xc6, value.length), value]);
  if (typeof value === 'string') return Buffer.concat([head(0xdb, Buffer.byteLength(value)), Buffer.from(value)]);
  if (Number.isInteger(value) && value >= 0 && value < 2 ** 32) return head(0xce, value);
  if (typeof value === 'number') {
    const double = Buffer.alloc(9, 0xcb);
    double.writeDoubleBE(value, 1);
    return double;
  }
  if (Array.isArray(value)) return Buffer.concat([head(0xdd, value.length), ...value.map(pack)]);
  const entries = Object.entries(value);
  return Buffer.concat([head(0xdf, entries.length), ...entries.flat().map(pack)]);
}

function head(type, number) {
  const bytes = Buffer.alloc(5, type);
  bytes.writeUInt32BE(number, 1);
  return bytes;
}

/** Ask the gateway; what it refuses is told in its own words. */
async function call(method, path, body, type = 'application/json', bearer = process.env.ROBOSAC_API_KEY) {
  const headers = { ...(body && { 'Content-Type': type }), ...(bearer && { Authorization: `Bearer ${bearer}` }) };
  const response = await fetch(gateway + path, { method, body, headers });
  const text = await response.text();
  if (!response.ok) throw new Error(`${method} ${path}: ${response.status} ${text}`);
  return text && JSON.parse(text);
}

/** A message of zeros, sent from x metres to the east of the world's origin. */
function message(layout, x) {
  const tensors = Object.entries(layout).map(([name, { dtype, shape }]) => {
    const bytesEach = Number(dtype.match(/\d+$/)?.[0] ?? 8) / 8; // float16, uint8, bool
    return [name, { dtype, shape, data: Buffer.alloc(shape.reduce((a, b) => a * b, bytesEach)) }];
  });
  return { pose: [1, 0, 0, x, 0, 1, 0, 0, 0, 0, 1, 1.8, 0, 0, 0, 1], tensors: Object.fromEntries(tensors) };
}

const team = ['car-2', 'car-3'];
const opened = await call('POST', '/v1/sessions', JSON.stringify({ ego_id: 'car-1', teammates: team }));
const { session_id: session, ego_token: token, detector: { name, tensors } } = opened;
console.log(`session ${session}, detector ${name}, defence ${opened.defense.kind}`);
for (let frame = 0; frame < Number(frames); frame++) {
  const teammates = Object.fromEntries(team.map((id, i) => [id, message(tensors.teammate, 8 * (i + 1))]));
  const body = pack({ frame, ego: message(tensors.ego, 0), teammates });
  const answer = await call('POST', `/v1/sessions/${session}/frames`, body, 'application/vnd.msgpack', token);
  const { source, boxes, accepted, rejected, timings_ms: { total } } = answer;
  const left = rejected.map((entry) => `${entry.vehicle_id} (${entry.reason})`).join(', ') || 'nobody';
  const fused = accepted.join(', ') || 'nobody';
  console.log(`frame ${answer.frame}: ${source}, ${boxes.length} boxes, fused ${fused}, left out ${left}, ${total} ms`);
}
await call('DELETE', `/v1/sessions/${session}`, undefined, undefined, token);
