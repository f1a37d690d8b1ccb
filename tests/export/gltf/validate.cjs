// Prints the report of Khronos' validator on a GLB, whose extension semantics it does not know yet: with `plain`
// they are renamed to semantics of an application, of the same length, so that the accessors are validated, too.
const fs = require("node:fs");
const [modules, file, plain] = process.argv.slice(2);
const validator = require(`${modules}/gltf-validator`);
let bytes = fs.readFileSync(file);
if (plain) {
  const size = bytes.readUInt32LE(12);
  const text = bytes.toString("latin1", 20, 20 + size).replaceAll("KHR_gaussian_splatting:", "_HR_GAUSSIAN_SPLATTING_");
  bytes = Buffer.concat([bytes.subarray(0, 20), Buffer.from(text, "latin1"), bytes.subarray(20 + size)]);
}
validator.validateBytes(new Uint8Array(bytes), {maxIssues: 0}).then((report) => console.log(JSON.stringify(report)));
