  // Rollouts in space, as frictionzoo.report.replay records them; drawn when something changes, and not otherwise.
  const { replay } = state;
  const [stage, play, seek, clock, which, speed, gain, apart] =
    ["stage", "play", "seek", "clock", "which", "speed", "gain", "apart"].map(id => document.getElementById(id));
  const boxes = [...document.querySelectorAll("[data-motion]")];
  const MEASURED = replay.motions.findIndex(({ name }) => name === "measured");
  let time = 0, playing = false, view = null;
  const rollout = () => replay.rollouts[which.value];

  // Joint positions of a motion at this time, on a straight line between frames; null once it has diverged.
  const between = motion => {
    const joints = rollout().positions[motion], last = joints[0].length - 1, end = (replay.duration / replay.step) | 0;
    const at = Math.min(time / replay.step, end), frame = Math.min(Math.floor(at), Math.max(0, last - 1));
    if (last < 0 || (at > last && last < end)) return null;
    const share = last ? at - frame : 0;
    return joints.map(own => replay.finest * (own[frame] + share * ((own[frame + 1] ?? own[frame]) - own[frame])));
  };
  // The same with its errors as large as they are wanted.
  const positionsAt = motion => {
    const own = between(motion), measured = between(MEASURED);
    return own?.map((position, joint) => measured[joint] + gain.value * (position - measured[joint])) ?? null;
  };

  // A line through the figures of this rollout.
  const mark = canvas => {
    const line = canvas.querySelector(":scope > .cursor") ?? document.createElement("div");
    line.className = "cursor";
    if (!line.isConnected) canvas.append(line);
    const { xaxis, _size: size } = canvas._fullLayout ?? {};
    const [low, high] = xaxis?.range ?? [1, 0];
    line.hidden = Number(canvas.dataset.rollout) !== rollout().rollout || time < low || time > high;
    if (line.hidden) return;
    Object.assign(line.style, { left: `${xaxis._offset + xaxis.l2p(time)}px`, top: `${size.t}px`, height: `${size.h}px` });
  };
  const own = () => timed.filter(canvas => "rollout" in canvas.dataset);
  // Of a rollout that has no figures of its own, some like those of the others.
  const others = document.getElementById("others");
  const boards = [...others.querySelectorAll("[data-like]")];
  const drawOther = () => {
    const { rollout: number, label, positions } = rollout(), measured = positions[MEASURED];
    const at = measured[0].map((_, frame) => frame * replay.step);
    const mean = values => values.reduce((sum, value) => sum + value, 0) / values.length;
    const away = joints => joints[0].map((_, frame) => replay.finest * mean(joints.map((own, joint) => Math.abs(own[frame] - measured[joint][frame]))));
    const place = joints => joints[0].map(value => replay.finest * value);
    const inSight = places => {
      const [low, high] = [Math.min(...places), Math.max(...places)], room = 0.05 * (high - low || 1);
      return [low - room, high + room];
    };
    others.hidden = own().some(canvas => !boards.includes(canvas) && Number(canvas.dataset.rollout) === number);
    for (const board of boards) {
      board.dataset.rollout = number;
      const { data, layout } = structuredClone(figures[board.dataset.like]), positioned = "yaxis2" in layout;
      const motionOf = name => positions[replay.motions.findIndex(motion => motion.name === name)];
      const curves = data.filter(({ name, fill, yaxis }) => motionOf(name) && !fill && yaxis === "y");
      curves.forEach(curve => Object.assign(curve, { x: at, y: (positioned ? place : away)(motionOf(curve.name)) }));
      if (positioned) {
        delete layout.yaxis2;
        Object.assign(layout.yaxis, { domain: [0, 1], range: inSight([measured, positions[0]].flatMap(place)) });
        layout.xaxis.anchor = "y";
      }
      delete layout.annotations;
      figures[board.dataset.figure] = { data: curves, layout };
      board.parentElement.querySelector("h3").textContent = `Rollout ${label}`;
    }
    return Promise.all(others.hidden ? [] : boards.map(board => draw(board, scheme.matches, {}))).then(listen);
  };
  const show = () => {
    seek.value = time;
    clock.textContent = `${time.toFixed(2)} s`;
    seek.setAttribute("aria-valuetext", clock.textContent);
    boxes.forEach((box, motion) => {
      box.closest("label").querySelector(".sub").textContent = positionsAt(motion) ? "" : "diverged";
    });
    own().forEach(mark);
    view?.();
  };
  const go = to => {
    time = Math.min(Math.max(to, 0), replay.duration);
    show();
  };
  const run = on => {
    playing = on;
    play.textContent = on ? "Pause" : "Play";
    if (on && time >= replay.duration) time = 0;
    let before = null;
    const advance = now => {
      if (!playing) return;
      go(time + (before === null ? 0 : Math.min(now - before, 100) / 1000 * speed.value));
      before = now;
      if (time < replay.duration) requestAnimationFrame(advance);
      else run(false);
    };
    if (on) requestAnimationFrame(advance);
  };
  play.addEventListener("click", () => run(!playing));
  seek.addEventListener("input", () => { run(false); go(Number(seek.value)); });
  [which, gain].forEach(choice => choice.addEventListener("change", () => { view?.frame(); show(); }));
  which.addEventListener("change", drawOther);
  [apart, ...boxes].forEach(box => box.addEventListener("change", show));
  attend = canvas => {
    if (!("rollout" in canvas.dataset)) return;
    canvas.on("plotly_afterplot", () => mark(canvas));
    canvas.on("plotly_hover", ({ xvals, points }) => {
      const at = replay.rollouts.findIndex(each => each.rollout === Number(canvas.dataset.rollout));
      if (playing || at < 0) return;
      if (at !== Number(which.value)) {
        which.value = at;
        view?.frame();
        drawOther();
      }
      go(xvals?.[0] ?? points[0].x);
    });
    mark(canvas);
  };

  const shapeOf = {
    box: ([x, y, z]) => new THREE.BoxGeometry(2 * x, 2 * y, 2 * z),
    sphere: ([radius]) => new THREE.SphereGeometry(radius, 24, 16),
    ellipsoid: ([x, y, z]) => new THREE.SphereGeometry(1, 24, 16).scale(x, y, z),
    capsule: ([radius, half]) => new THREE.CapsuleGeometry(radius, 2 * half, 8, 20).rotateX(Math.PI / 2),
    cylinder: ([radius, half]) => new THREE.CylinderGeometry(radius, radius, 2 * half, 28).rotateX(Math.PI / 2),
    mesh: (size, mesh) => {
      const { low, cell, vertices, faces } = replay.meshes[mesh], geometry = new THREE.BufferGeometry();
      const places = faces.flatMap(corner => [0, 1, 2].map(axis => low[axis] + cell * vertices[3 * corner + axis]));
      geometry.setAttribute("position", new THREE.BufferAttribute(new Float32Array(places), 3));
      geometry.computeVertexNormals(); // of triangles that share no corner: flat
      return geometry;
    },
  };
  // The bodies, each within its parent, with some of the shapes.
  const assemble = (shapes, material) => {
    const bodies = replay.bodies.map(() => new THREE.Group());
    bodies.slice(1).forEach((body, at) => bodies[replay.bodies[at + 1].parent].add(body));
    for (const { body, shape, size, mesh, pos, quat, backdrop } of shapes) {
      const solid = new THREE.Mesh(shapeOf[shape](size, mesh), material);
      solid.userData.backdrop = backdrop;
      solid.position.fromArray(pos);
      solid.quaternion.fromArray(quat).normalize();
      bodies[body].add(solid);
    }
    return bodies;
  };
  // MuJoCo's kinematics: a body in its parent, and then its joints, one after the other.
  const pose = (bodies, positions) => bodies.forEach((body, at) => {
    const { pos, quat, joints } = replay.bodies[at];
    body.position.fromArray(pos);
    body.quaternion.fromArray(quat).normalize();
    for (const joint of joints) {
      const axis = new THREE.Vector3().fromArray(joint.axis), moved = positions[joint.at] - joint.reference;
      if (joint.slide) {
        body.position.addScaledVector(axis.applyQuaternion(body.quaternion), moved);
        continue;
      }
      const anchor = new THREE.Vector3().fromArray(joint.pos).applyQuaternion(body.quaternion).add(body.position);
      body.quaternion.multiply(new THREE.Quaternion().setFromAxisAngle(axis, moved));
      body.position.copy(anchor).sub(new THREE.Vector3().fromArray(joint.pos).applyQuaternion(body.quaternion));
    }
  });

  const openStage = context => {
    const renderer = new THREE.WebGLRenderer({ canvas: context.canvas, context });
    renderer.setPixelRatio(Math.min(devicePixelRatio, 2));
    renderer.setScissorTest(true);
    const scene = new THREE.Scene(), camera = new THREE.PerspectiveCamera(28, 1, 0.01, 100), sun = new THREE.DirectionalLight("#fff", 1.6);
    camera.up.set(0, 0, 1);
    scene.add(new THREE.HemisphereLight("#fff", "#aab", 2), sun);
    const paintIn = ({ color, opacity }) =>
      new THREE.MeshLambertMaterial({
        color: paint(color, scheme.matches), opacity, transparent: opacity < 1, depthWrite: opacity === 1,
        polygonOffset: opacity < 1, polygonOffsetFactor: 1, polygonOffsetUnits: 4, // seen where it sticks out of what is solid
      });
    let motions = [], scenery = [], corners = [], centre = new THREE.Vector3(), distances = new Map(), zoom = 1;
    let [azimuth, elevation] = replay.view;

    const clear = () => {
      scene.children.filter(child => child.isGroup).forEach(child => scene.remove(child));
      scene.traverse(({ geometry, material }) => { geometry?.dispose(); material?.dispose(); });
    };
    const build = () => {
      clear();
      const shapes = [...replay.shapes, ...rollout().shapes];
      scenery = assemble(shapes.filter(({ moves }) => !moves), paintIn(replay.scenery));
      pose(scenery, replay.bodies.flatMap(body => body.joints).reduce((at, joint) => ({ ...at, [joint.at]: joint.reference }), {}));
      motions = replay.motions.map(motion => assemble(shapes.filter(({ moves }) => moves), paintIn(motion)));
      scene.add(scenery[0], ...motions.map(([world]) => world));
    };
    const reach = world => {
      world.updateMatrixWorld(true);
      world.traverse(({ geometry, matrixWorld, userData }) => {
        if (!geometry || userData.backdrop) return;
        geometry.computeBoundingBox();
        const { min, max } = geometry.boundingBox;
        for (const x of [min.x, max.x]) for (const y of [min.y, max.y]) for (const z of [min.z, max.z])
          corners.push(new THREE.Vector3(x, y, z).applyMatrix4(matrixWorld));
      });
    };
    // All that the measured and the modelled motion pass through; what has no friction may leave the stage.
    const measure = () => {
      const now = time;
      corners = [];
      distances = new Map();
      reach(scenery[0]);
      for (let i = 0; i <= 24; i++) {
        time = replay.duration * i / 24;
        motions.slice(0, 2).forEach((bodies, motion) => {
          const positions = positionsAt(motion);
          if (!positions) return;
          pose(bodies, positions);
          reach(bodies[0]);
        });
      }
      time = now;
      centre = new THREE.Box3().setFromPoints(corners).getCenter(new THREE.Vector3());
      for (let i = 0; i < 3 && corners.length; i++) centreOn();
    };
    const stand = distance => {
      const flat = Math.cos(elevation);
      const towards = new THREE.Vector3(flat * Math.cos(azimuth), flat * Math.sin(azimuth), Math.sin(elevation));
      camera.position.copy(centre).addScaledVector(towards, distance);
      camera.lookAt(centre);
      camera.updateMatrixWorld();
    };
    // Corners as one sees them from the centre, and how far away they are all in sight.
    const seen = () => {
      stand(1);
      return corners.map(corner => corner.clone().applyMatrix4(camera.matrixWorldInverse));
    };
    const standBack = (places, aspect) => {
      const high = Math.tan(camera.fov * Math.PI / 360) / 1.05;
      return places.reduce((most, { x, y, z }) => Math.max(most, z + 1 + Math.max(Math.abs(x) / aspect, Math.abs(y)) / high), 1e-3);
    };
    // What is nearer looks larger: the middle of the picture is not that of the places.
    const centreOn = () => {
      const places = seen(), distance = standBack(places, 1);
      const middle = ["x", "y"].map(axis => {
        const drawn = places.map(place => place[axis] * distance / (distance - 1 - place.z));
        return (drawn.reduce((a, b) => Math.min(a, b)) + drawn.reduce((a, b) => Math.max(a, b))) / 2;
      });
      centre.add(new THREE.Vector3(...middle, 0).applyQuaternion(camera.quaternion));
    };
    // How far away all corners are in sight, from where one looks at first; turning does not move one to and fro.
    const fitTo = aspect => {
      if (!distances.has(aspect)) distances.set(aspect, standBack(seen(), aspect));
      return distances.get(aspect) / zoom;
    };
    const look = aspect => {
      const distance = fitTo(aspect);
      Object.assign(camera, { aspect, near: distance / 100, far: 20 * distance });
      camera.updateProjectionMatrix();
      stand(distance);
      sun.position.copy(camera.position).sub(centre).add(new THREE.Vector3(0, 0, distance / 2));
    };
    const render = () => {
      const { clientWidth: width, clientHeight: height } = stage;
      if (!width || !height) return;
      renderer.setSize(width, height);
      const chosen = motions.map((bodies, motion) => {
        const positions = boxes[motion].checked ? positionsAt(motion) : null;
        if (positions) pose(bodies, positions);
        return positions ? bodies[0] : null;
      });
      const several = apart.checked && chosen.some(Boolean);
      const parts = several ? chosen.filter(Boolean).map(part => [part]) : [chosen];
      parts.forEach((part, at) => {
        const [x, wide] = [width * at / parts.length, width / parts.length];
        motions.forEach(([world]) => (world.visible = part.includes(world)));
        renderer.setViewport(x, 0, wide, height);
        renderer.setScissor(x, 0, wide, height);
        look(wide / height);
        renderer.render(scene, camera);
      });
    };
    let waiting = false;
    view = () => {
      if (!waiting) requestAnimationFrame(() => { waiting = false; render(); });
      waiting = true;
    };
    view.frame = () => { build(); measure(); };
    const turn = (by, up, nearer = 1) => {
      azimuth += by;
      elevation = Math.min(Math.max(elevation + up, -1.5), 1.5);
      zoom = Math.min(Math.max(zoom * nearer, 0.2), 10);
      view();
    };
    let held = null;
    stage.addEventListener("pointerdown", event => {
      held = [event.clientX, event.clientY];
      stage.setPointerCapture(event.pointerId);
    });
    stage.addEventListener("pointermove", event => {
      if (!held) return;
      turn((held[0] - event.clientX) / 150, (event.clientY - held[1]) / 150);
      held = [event.clientX, event.clientY];
    });
    ["pointerup", "pointercancel"].forEach(kind => stage.addEventListener(kind, () => (held = null)));
    const keys = { ArrowLeft: [-0.1, 0], ArrowRight: [0.1, 0], ArrowUp: [0, 0.1], ArrowDown: [0, -0.1], "+": [0, 0, 1.15], "-": [0, 0, 1 / 1.15] };
    stage.addEventListener("keydown", event => {
      if (!(event.key in keys) || event.ctrlKey || event.metaKey) return;
      event.preventDefault();
      turn(...keys[event.key]);
    });
    new ResizeObserver(view).observe(stage);
    scheme.addEventListener("change", () => { build(); view(); });
    view.frame();
    // Where the bodies of a motion are, in MuJoCo's frame and order, for whoever works on this page.
    stage.bodies = motion => {
      render();
      return motions[motion].map(body => [body.getWorldPosition(new THREE.Vector3()), body.getWorldQuaternion(new THREE.Quaternion())])
        .map(([{ x, y, z }, turned]) => [x, y, z, turned.w, turned.x, turned.y, turned.z]);
    };
  };
  finish = async () => {
    const canvas = document.createElement("canvas");
    const context = canvas.getContext("webgl2", { antialias: true, alpha: true });
    if (!context) {
      document.getElementById("flat").hidden = false;
      stage.closest(".replay").classList.add("flat");
      return;
    }
    await load("three");
    stage.append(canvas);
    const colors = replay.motions.map(({ color }) => paint(color, scheme.matches));
    boxes.forEach((box, motion) => (box.nextElementSibling.style.background = colors[motion]));
    openStage(context);
    show();
  };
