// An SDF in Gazebo's physics: `gazebo PLUGIN bench.sdf TIMESTEP X Y Z STEPS JOINT...`, with gravity along X, Y and Z.
//
// First it writes a line, that physics' version. Then it reads rollouts: positions and velocities where one begins, and
// STEPS times forces or torques. It answers each of these with positions and velocities after the step. All are numbers of
// 64 bits, one for each joint. Of what libsdformat finds amiss with the file, or warns of, it says the first and ends.

#include <chrono>
#include <ignition/physics/ForwardStep.hh>
#include <ignition/physics/GetEntities.hh>
#include <ignition/physics/Joint.hh>
#include <ignition/physics/RequestEngine.hh>
#include <ignition/physics/config.hh>
#include <ignition/physics/sdf/ConstructModel.hh>
#include <ignition/physics/sdf/ConstructWorld.hh>
#include <ignition/plugin/Loader.hh>
#include <iostream>
#include <sdf/sdf.hh>
#include <string>
#include <vector>

namespace physics = ignition::physics;

using Features = physics::FeatureList<physics::ForwardStep, physics::GetEntities, physics::GetBasicJointState,
                                      physics::SetBasicJointState, physics::sdf::ConstructSdfModel,
                                      physics::sdf::ConstructSdfWorld>;

int fail(const std::string& reason) {
  std::cerr << reason << std::endl;
  return 1;
}

bool read(std::vector<double>& numbers) {
  return bool(std::cin.read(reinterpret_cast<char*>(numbers.data()), numbers.size() * sizeof(double)));
}

void write(const std::vector<double>& numbers) {
  std::cout.write(reinterpret_cast<const char*>(numbers.data()), numbers.size() * sizeof(double)).flush();
}

int main(int count, char** arguments) {
  ignition::plugin::Loader loader;
  loader.LoadLib(arguments[1]);
  const auto engine = physics::RequestEngine3d<Features>::From(loader.Instantiate("ignition::physics::dartsim::Plugin"));
  if (!engine) return fail(std::string("no physics engine in ") + arguments[1]);

  sdf::ParserConfig strict;
  strict.SetWarningsPolicy(sdf::EnforcementPolicy::ERR);
  strict.SetUnrecognizedElementsPolicy(sdf::EnforcementPolicy::ERR);
  sdf::Root file;
  for (const sdf::Error& error : file.Load(arguments[2], strict)) return fail("libsdformat: " + error.Message());
  sdf::World empty;
  empty.SetName("world");
  empty.SetGravity({std::stod(arguments[4]), std::stod(arguments[5]), std::stod(arguments[6])});
  const auto world = engine->ConstructWorld(empty);
  const auto model = world->ConstructModel(*file.Model());
  std::vector<decltype(model->GetJoint(0))> joints;
  for (int number = 8; number < count; ++number) {
    joints.push_back(model->GetJoint(arguments[number]));
    if (!joints.back()) return fail(std::string("no joint ") + arguments[number]);
  }

  physics::ForwardStep::Input input;
  physics::ForwardStep::Output output;
  physics::ForwardStep::State state;
  const std::chrono::duration<double> timestep(std::stod(arguments[3]));
  input.Get<std::chrono::steady_clock::duration>() = std::chrono::round<std::chrono::nanoseconds>(timestep);
  const int steps = std::stoi(arguments[7]);
  const size_t size = joints.size();
  std::vector<double> moving(2 * size), force(size);
  std::cout << IGNITION_PHYSICS_VERSION_FULL << std::endl;
  while (read(moving)) {
    for (size_t joint = 0; joint < size; ++joint) {
      joints[joint]->SetPosition(0, moving[joint]);
      joints[joint]->SetVelocity(0, moving[size + joint]);
    }
    for (int step = 0; step < steps && read(force); ++step) {
      for (size_t joint = 0; joint < size; ++joint) joints[joint]->SetForce(0, force[joint]);
      world->Step(output, state, input);
      for (size_t joint = 0; joint < size; ++joint) {
        moving[joint] = joints[joint]->GetPosition(0);
        moving[size + joint] = joints[joint]->GetVelocity(0);
      }
      write(moving);
    }
  }
}
