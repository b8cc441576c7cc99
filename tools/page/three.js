// The parts of three.js that viewer.js uses; `make page` bundles them into three.min.js.
export {
  BufferAttribute, BufferGeometry, Color, DirectionalLight, DoubleSide, Fog, FrontSide, GridHelper, Group, Line,
  LineBasicMaterial, LineSegments, Matrix4, Mesh, MeshBasicMaterial, MeshStandardMaterial, NeutralToneMapping,
  PCFShadowMap, PMREMGenerator, PerspectiveCamera, Plane, Points, PointsMaterial, Quaternion, Raycaster,
  RepeatWrapping, SRGBColorSpace, Scene, SphereGeometry, Texture, Vector2, Vector3, WebGLRenderer,
} from "three";
export { OrbitControls } from "three/addons/controls/OrbitControls.js";
