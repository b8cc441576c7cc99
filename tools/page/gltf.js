// What a test of --to glb uses to open it in a browser; `make page` bundles it into tests/exporters/gltf.min.js.
export { AnimationMixer, REVISION } from "three";
export { GLTFLoader } from "three/addons/loaders/GLTFLoader.js";
