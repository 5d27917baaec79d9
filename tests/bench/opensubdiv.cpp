// Refined vertices by OpenSubdiv (3.5 was tried): its factorised stencils on all cores, and its PrimvarRefiner on one.

#include <opensubdiv/far/primvarRefiner.h>
#include <opensubdiv/far/stencilTableFactory.h>
#include <opensubdiv/far/topologyDescriptor.h>
#include <opensubdiv/osd/bufferDescriptor.h>
#include <opensubdiv/osd/ompEvaluator.h>

#include <memory>
#include <vector>

using namespace OpenSubdiv;

struct Vertex {
    float x[3];
    void Clear(void* = nullptr) { x[0] = x[1] = x[2] = 0; }
    void AddWithWeight(Vertex const& other, float weight) {
        for (int i = 0; i < 3; i++) x[i] += weight * other.x[i];
    }
};

struct Tables {
    std::unique_ptr<Far::TopologyRefiner> refiner;
    std::unique_ptr<Far::StencilTable const> stencils;
    std::vector<Vertex> levels;
};

extern "C" {

Tables* build(bool triangles, int n_vertices, int n_faces, int const* faces, int levels, bool stencils) {
    int corners = triangles ? 3 : 4;
    std::vector<int> sizes(n_faces, corners);
    Far::TopologyDescriptor mesh;
    mesh.numVertices = n_vertices, mesh.numFaces = n_faces;
    mesh.numVertsPerFace = sizes.data(), mesh.vertIndicesPerFace = faces;
    using Factory = Far::TopologyRefinerFactory<Far::TopologyDescriptor>;
    Factory::Options options(triangles ? Sdc::SCHEME_LOOP : Sdc::SCHEME_CATMARK, Sdc::Options());
    auto tables = new Tables;
    tables->refiner.reset(Factory::Create(mesh, options));
    tables->refiner->RefineUniform(Far::TopologyRefiner::UniformOptions(levels));
    tables->levels.resize(tables->refiner->GetNumVerticesTotal());
    if (stencils) {
        Far::StencilTableFactory::Options which;
        which.generateIntermediateLevels = false, which.generateOffsets = true;
        tables->stencils.reset(Far::StencilTableFactory::Create(*tables->refiner, which));
    }
    return tables;
}

int n_refined(Tables const* tables) { return tables->refiner->GetLevel(tables->refiner->GetMaxLevel()).GetNumVertices(); }

void run_stencils(Tables const* tables, float const* control, float* refined) {
    Osd::BufferDescriptor xyz(0, 3, 3);
    Far::StencilTable const& rows = *tables->stencils;
    Osd::OmpEvaluator::EvalStencils(control, xyz, refined, xyz, rows.GetSizes().data(), rows.GetOffsets().data(),
                                    rows.GetControlIndices().data(), rows.GetWeights().data(), 0, rows.GetNumStencils());
}

void run_levels(Tables* tables, float const* control, float* refined) {
    Far::PrimvarRefiner refiner(*tables->refiner);
    Vertex const* from = reinterpret_cast<Vertex const*>(control);
    Vertex* to = tables->levels.data();
    int last = tables->refiner->GetMaxLevel();
    for (int level = 1; level <= last; level++) {
        if (level == last) to = reinterpret_cast<Vertex*>(refined);
        refiner.Interpolate(level, from, to);
        from = to, to += tables->refiner->GetLevel(level).GetNumVertices();
    }
}

void discard(Tables* tables) { delete tables; }
}
