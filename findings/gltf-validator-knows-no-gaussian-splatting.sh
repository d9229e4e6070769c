#!/usr/bin/env bash
# gltf-validator 2.0.0-dev.3.10 (npm): a splat as KHR_gaussian_splatting prescribes it gets an error for
# each attribute's name (MESH_PRIMITIVE_INVALID_ATTRIBUTE) besides the notice that the extension is
# unknown. Attributes of extensions are namespaced KHR_gaussian_splatting:NAME, and the validator knows
# only names of the core and those that begin with an underscore. Needs node and npm.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
cd "$folder"
npm install --silent --no-audit --no-fund gltf-validator@2.0.0-dev.3.10 > /dev/null
cat > check.js <<'JS'
const validator = require("gltf-validator");
const splat = [["POSITION", "VEC3", [1, 2, 3]], ["KHR_gaussian_splatting:ROTATION", "VEC4", [0, 0, 0, 1]],
  ["KHR_gaussian_splatting:SCALE", "VEC3", [0.1, 0.1, 0.1]], ["KHR_gaussian_splatting:OPACITY", "SCALAR", [0.5]],
  ["KHR_gaussian_splatting:SH_DEGREE_0_COEF_0", "VEC3", [0.1, 0.2, 0.3]]];
const bytes = Buffer.from(new Float32Array(splat.flatMap(([, , values]) => values)).buffer);
let offset = 0;
const views = [], accessors = [], attributes = {};
for (const [name, type, values] of splat) {
  attributes[name] = accessors.length;
  accessors.push({ bufferView: views.length, componentType: 5126, count: 1, type,
    ...(name === "POSITION" ? { min: values, max: values } : {}) });
  views.push({ buffer: 0, byteOffset: offset, byteLength: 4 * values.length, target: 34962 });
  offset += 4 * values.length;
}
const gltf = {
  asset: { version: "2.0" }, scene: 0, scenes: [{ nodes: [0] }], nodes: [{ mesh: 0 }],
  extensionsUsed: ["KHR_gaussian_splatting"],
  buffers: [{ byteLength: bytes.length, uri: "data:application/octet-stream;base64," + bytes.toString("base64") }],
  bufferViews: views, accessors,
  meshes: [{ primitives: [{ mode: 0, attributes,
    extensions: { KHR_gaussian_splatting: { kernel: "ellipse", colorSpace: "srgb_rec709_display" } } }] }],
};
validator.validateString(JSON.stringify(gltf)).then(({ issues }) => {
  const codes = {};
  for (const { code } of issues.messages) codes[code] = (codes[code] || 0) + 1;
  console.log(JSON.stringify({ errors: issues.numErrors, ...codes }));
  const seen = issues.numErrors === 4 && codes.MESH_PRIMITIVE_INVALID_ATTRIBUTE === 4
    && codes.UNSUPPORTED_EXTENSION === 1;
  process.exit(seen ? 0 : 1);
});
JS
node check.js || { echo changed; exit 1; }
echo "as seen: gltf-validator 2.0.0-dev.3.10"
