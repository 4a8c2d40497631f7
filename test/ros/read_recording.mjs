// Prints a line of JSON for each message of a recording: topic, sum of the arc tangents of its numbers, length of its texts.
import {McapStreamReader} from '@mcap/core';
import {parse} from '@foxglove/rosmsg';
import {MessageReader} from '@foxglove/rosmsg2-serialization';
import {decompress} from 'fzstd';
import {readFileSync} from 'node:fs';

function add(value, found) {
  if (typeof value === 'string') found.length += value.length;
  else if (typeof value !== 'object') found.sum += Math.atan(Number(value));
  else for (const part of ArrayBuffer.isView(value) ? value : Object.values(value)) add(part, found);
}

const stream = new McapStreamReader({
  decompressHandlers: {zstd: (data, size) => decompress(data, new Uint8Array(Number(size)))}, validateCrcs: true});
stream.append(readFileSync(process.argv[2]));
const schemas = new Map(), channels = new Map();
for (let record; (record = stream.nextRecord());) {
  if (record.type === 'Schema') {
    schemas.set(record.id, parse(new TextDecoder().decode(record.data), {ros2: true}));
  } else if (record.type === 'Channel') {
    channels.set(record.id, {topic: record.topic, reader: new MessageReader(schemas.get(record.schemaId))});
  } else if (record.type === 'Message') {
    const {topic, reader} = channels.get(record.channelId);
    const found = {sum: 0, length: 0};
    add(reader.readMessage(record.data), found);
    console.log(JSON.stringify({topic, ...found}));
  }
}
