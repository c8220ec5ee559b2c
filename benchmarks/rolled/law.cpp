// An exported TorchScript law in libtorch: `law friction.pt JOINTS` reads states from its input and writes friction.
//
// First it writes a line, libtorch's version. A state is the law's inputs in their order, and what comes back its outputs,
// each a number of 64 bits for each joint.

#include <torch/script.h>
#include <torch/version.h>

#include <iostream>
#include <vector>

int main(int, char** arguments) {
  torch::jit::Module law = torch::jit::load(arguments[1]);
  const int64_t joints = std::stoll(arguments[2]);
  const size_t inputs = law.get_method("forward").function().getSchema().arguments().size() - 1;  // but `self`
  std::vector<double> state(inputs * joints);
  const std::streamsize bytes = state.size() * sizeof(double);
  const torch::NoGradGuard none;
  std::cout << TORCH_VERSION << std::endl;
  while (std::cin.read(reinterpret_cast<char*>(state.data()), bytes)) {
    std::vector<torch::IValue> rows;
    for (size_t input = 0; input < inputs; ++input)
      rows.push_back(torch::from_blob(&state[input * joints], {1, joints}, torch::kFloat64));
    const torch::IValue outputs = law.forward(rows);  // outlives the loop over what it holds
    for (const torch::IValue& output : outputs.toTupleRef().elements()) {
      const torch::Tensor friction = output.toTensor().contiguous();
      std::cout.write(static_cast<const char*>(friction.data_ptr()), friction.nbytes());
    }
    std::cout.flush();
  }
}
