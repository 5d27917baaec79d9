// Refined and limit vertices of the cases in opensubdiv.py, by OpenSubdiv 3.5.0 (Debian's libosd-dev):
//   g++ -O1 tests/opensubdiv.cpp -losdCPU -o vectors && PYTHONPATH=. python tests/opensubdiv.py ./vectors
#include <opensubdiv/far/primvarRefiner.h>
#include <opensubdiv/far/topologyDescriptor.h>

#include <cstdio>
#include <iostream>
#include <string>
#include <vector>

using namespace OpenSubdiv;

struct Point {
    double x[3];
    void Clear(void* = nullptr) { x[0] = x[1] = x[2] = 0; }
    void AddWithWeight(Point const& other, double weight) {
        for (int i = 0; i < 3; i++) x[i] += weight * other.x[i];
    }
};

int main() {
    std::string scheme, boundary;
    int levels;
    while (std::cin >> scheme >> boundary >> levels) {
        int n;
        std::cin >> n;
        std::vector<Point> points(n);
        for (auto& p : points) std::cin >> p.x[0] >> p.x[1] >> p.x[2];
        Far::TopologyDescriptor mesh;
        mesh.numVertices = n;
        std::cin >> n;
        std::vector<int> counts(n), corners;
        for (auto& count : counts) {
            std::cin >> count;
            for (int i = 0, v; i < count; i++) std::cin >> v, corners.push_back(v);
        }
        mesh.numFaces = n, mesh.numVertsPerFace = counts.data(), mesh.vertIndicesPerFace = corners.data();
        std::cin >> n;
        std::vector<int> edges(2 * n);
        std::vector<float> edge_sharpness(n);
        for (int i = 0; i < n; i++) std::cin >> edges[2 * i] >> edges[2 * i + 1] >> edge_sharpness[i];
        mesh.numCreases = n, mesh.creaseVertexIndexPairs = edges.data(), mesh.creaseWeights = edge_sharpness.data();
        std::cin >> n;
        std::vector<int> sharp(n);
        std::vector<float> vertex_sharpness(n);
        for (int i = 0; i < n; i++) std::cin >> sharp[i] >> vertex_sharpness[i];
        mesh.numCorners = n, mesh.cornerVertexIndices = sharp.data(), mesh.cornerWeights = vertex_sharpness.data();

        Sdc::Options options;
        options.SetVtxBoundaryInterpolation(boundary == "edge-only" ? Sdc::Options::VTX_BOUNDARY_EDGE_ONLY
                                                                    : Sdc::Options::VTX_BOUNDARY_EDGE_AND_CORNER);
        typedef Far::TopologyRefinerFactory<Far::TopologyDescriptor> Factory;
        auto type = scheme == "Loop" ? Sdc::SCHEME_LOOP : Sdc::SCHEME_CATMARK;
        auto* refiner = Factory::Create(mesh, Factory::Options(type, options));
        Far::TopologyRefiner::UniformOptions uniform(levels);
        uniform.fullTopologyInLastLevel = true;
        refiner->RefineUniform(uniform);
        Far::PrimvarRefinerReal<double> values(*refiner);
        for (int level = 1; level <= levels; level++) {
            std::vector<Point> finer(refiner->GetLevel(level).GetNumVertices());
            Point *from = points.data(), *to = finer.data();
            values.Interpolate(level, from, to);
            points = finer;
        }
        std::vector<Point> limit(points.size()), along(points.size()), across(points.size());
        Point *from = points.data(), *to = limit.data(), *first = along.data(), *second = across.data();
        values.Limit(from, to, first, second);
        std::printf("case\n");
        for (size_t i = 0; i < points.size(); i++) {
            for (auto* p : {&points[i], &limit[i], &along[i], &across[i]})
                std::printf("%.17g %.17g %.17g ", p->x[0], p->x[1], p->x[2]);
            std::printf("\n");
        }
        delete refiner;
    }
}
